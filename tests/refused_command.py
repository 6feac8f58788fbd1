"""Runs a command in this process that must refuse what it is asked."""

import sys

import pytest

from experiments import devices


def refused(capsys, monkeypatch, command, *arguments) -> str:
    """Runs a command that must end with one line on standard error; returns that line."""
    # The tests' process has its devices already, also where they are not as many as its cores.
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    monkeypatch.setattr(sys, "argv", [command.__name__, *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    shown = capsys.readouterr()
    assert stopped.value.code == 2, shown
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1
    assert shown.out == ""
    return shown.err
