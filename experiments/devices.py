"""Prepares JAX for a command: a device for each core, and a lasting compilation cache."""

import gc
import os
from pathlib import Path

import jax

_OBJECTS_BETWEEN_COLLECTIONS = 20_000
"""New objects after which Python looks for garbage among the newest.

Tracing a program makes many that stay; looking after each 700, as Python does by default, takes a
tenth of the time of a smoke run. Far more would keep programs in memory that nobody can call.
"""


def usable_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def collect_garbage_seldom() -> None:
    """Lets Python look for garbage less often, which tracing makes slow."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS, 10, 10)


def prepare(*, cores: int | None = None) -> None:
    """Configures JAX; call it before the first computation.

    A population is shared out over all devices. One XLA program does not fill a CPU's cores by
    itself, so the host is split into one device a core (at most 8). Compiled programs are kept
    in the cache folder, so that the next command does not compile them again.

    Args:
        cores: host devices to make; one for each core this process may use by default.
    """
    collect_garbage_seldom()
    if cores is None:
        cores = min(8, usable_cores())
    jax.config.update("jax_num_cpu_devices", cores)
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "haland-jax"
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
