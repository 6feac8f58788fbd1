"""What all tests share: two host devices, a lasting compilation cache, one finished smoke run."""

import contextlib
import os

# XLA reports on every program that it loads from the compilation cache; read once, at start.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("TRANSFORMERS_NO_ADVISORY_WARNINGS", "1")

import databases
import filelock
import hypothesis
import jax
import pytest

from experiments import devices

devices.collect_garbage_seldom()

# Before the first computation: the code for populations must be tried on several devices.
jax.config.update("jax_num_cpu_devices", 2)

hypothesis.settings.register_profile(
    "deterministic",
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=15,
    # Without shrinking: a failure is found in a second, and shrunk in a minute.
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("deterministic")


def pytest_configure(config):
    """Keeps compiled programs between runs of the tests, also for the commands they start."""
    if getattr(config, "cache", None) is None:
        return
    folder = str(config.cache.mkdir("compiled"))
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder)
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    # The commands that tests start compile lightly too (`compiled`).
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    # Small programs too: both workers and the commands they start compile much the same ones.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_collection_modifyitems(items):
    """Orders the files for the workers, who take them in turn: those with slow tests first.

    Of the files that look at the smoke run the first one makes it; the others come after the slow
    ones, so that nobody waits for it.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    smoke = {item.path for item in items if "smoke_run" in item.fixturenames}

    def turn(item) -> int:
        if item.path in smoke:
            return 0 if item.path == min(smoke) else 2
        return 1 if item.path in slow else 3

    items.sort(key=turn)


@contextlib.contextmanager
def compiled(*, lightly: bool):
    """Programs compile lightly in half the time and run slower; for what runs for a moment only."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", lightly)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(autouse=True, scope="module")
def compilation(request):
    """Compiles programs lightly, but those of modules whose programs run for long."""
    long = request.node.get_closest_marker("full_compilation") is not None
    with compiled(lightly=not long):
        yield


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory, worker_id):
    """The folder of an uninterrupted smoke run; made once, not to be written to."""
    from experiments import configs, report, training
    from experiments.figures import draw_figures
    from experiments.pipeline import run_pipeline

    folder = tmp_path_factory.getbasetemp()
    if worker_id != "master":
        folder = folder.parent  # All workers share it.
    path = folder / "smoke"
    with filelock.FileLock(folder / "smoke.lock"):
        if not (path / "report" / "metrics.json").exists():
            with compiled(lightly=True), pytest.MonkeyPatch.context() as patched:
                # Pieces as in the interrupted run of test_pipeline.py, which has its programs then.
                patched.setattr(training, "UPDATES_PER_PIECE", 4)
                # With its figures, also where the module that comes first has `no_drawing`.
                patched.setattr(report, "draw_figures", draw_figures)
                run_pipeline(configs.smoke(configs.DEFAULT_ENVIRONMENT, seed=0), path)
    return path


@pytest.fixture(scope="module")
def no_drawing():
    """Reports name their figures and do not draw them; that has tests of its own."""
    from experiments import report

    def name_only(results, folder):
        folder.mkdir(exist_ok=True)
        return [folder / "returns_by_style.png", folder / "cross_play.png"]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(report, "draw_figures", name_only)
        yield


@pytest.fixture(scope="session")
def postgres():
    """A PostgreSQL server for these tests."""
    if databases.postgres_programs() is None:
        if os.environ.get("HALAND_NEEDS_POSTGRES"):
            pytest.fail("HALAND_NEEDS_POSTGRES is set, but PostgreSQL's server is not found")
        pytest.skip("PostgreSQL's server is not installed")
    with databases.postgres_server() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request, tmp_path):
    """A new, empty database."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'study.db'}"
    return databases.new_database(request.getfixturevalue("postgres"))
