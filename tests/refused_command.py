"""Runs a command in this process that must refuse what it is asked."""

import sys

import pytest


def refused(capsys, monkeypatch, command, *arguments) -> str:
    """Runs a command that must end with one line on standard error; returns that line."""
    monkeypatch.setattr(sys, "argv", [command.__name__, *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    shown = capsys.readouterr()
    assert stopped.value.code == 2, shown
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1
    assert shown.out == ""
    return shown.err
