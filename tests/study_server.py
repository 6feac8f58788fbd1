"""A study's server in a process of its own, for tests."""

import os
import shutil
import socket
import subprocess
from contextlib import contextmanager

import pytest

from experiments import benchmark_study

SECRET = "a secret for tests"
MODEL = "pretrained:lbf/spread"


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def serving(folder, port, *arguments, model="pretrained:overcooked/diverse_orders"):
    """A server that has begun to serve; gives its process and its address."""
    os.environ["HALAND_STUDY_SECRET"] = SECRET
    with benchmark_study.server(folder, port, "--run", model, *arguments) as process:
        yield process, f"http://127.0.0.1:{port}"


def browser_program():
    """The path of a Chromium; skips the test where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    if os.environ.get("HALAND_NEEDS_BROWSER"):
        pytest.fail("HALAND_NEEDS_BROWSER is set, but no Chromium is installed")
    pytest.skip("no Chromium is installed")


def log_of(folder):
    return (folder / "server.log").read_text()


def stop_hard(process: subprocess.Popen):
    """kill -9, as a crash."""
    process.kill()
    process.wait()
