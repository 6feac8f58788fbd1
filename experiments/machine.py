"""What numbers were measured on."""

import contextlib
import os
import platform
import time
from pathlib import Path
from typing import Any

import jax


def describe_machine() -> dict[str, Any]:
    """The machine, what runs on it, and today's date."""
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "devices": [str(device) for device in jax.devices()],
        "python": platform.python_version(),
        "jax": jax.__version__,
        "date": time.strftime("%Y-%m-%d"),
    }


def processor() -> str:
    """The processor's name; its kind where the system does not say."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or platform.machine()
