"""The arm's contest: what it says of its contenders' times, and that C MuJoCo plays."""

import time

import pytest
from rich.console import Console

from experiments import benchmark_arm
from experiments.benchmark_arm import OURS, PEER, PHYSICS

pytestmark = pytest.mark.full_compilation


@pytest.fixture
def found(monkeypatch):
    """The contest by cores, with ours played by the clock: 20 and 10 ms for 6 steps."""
    monkeypatch.setattr(benchmark_arm, "_environment", lambda *_: lambda: time.sleep(0.02))
    monkeypatch.setattr(benchmark_arm, "_physics", lambda *_: lambda: time.sleep(0.01))
    return {cores: benchmark_arm.measure_arm(2, 3, repeats=1, cores=cores) for cores in (1, 2)}


def test_speeds_are_steps_of_all_games_a_second(found):
    rows = found[2]
    assert 30 < rows[OURS]["steps_per_second"] <= 300
    assert 60 < rows[PHYSICS]["steps_per_second"] <= 600
    assert rows[PEER]["steps_per_second"] > 0
    for name in (OURS, PHYSICS):
        share = rows[name]["steps_per_second"] / rows[PEER]["steps_per_second"]
        assert rows[name]["ratio"] == pytest.approx(share)


def test_the_bar_is_that_of_two_cores(found):
    assert (found[2][OURS]["bar"], found[2][OURS]["met"]) == (50_000, False)
    assert "bar" not in found[1][OURS]


def test_the_table_names_all_engines(found):
    console = Console(record=True, width=120)
    for rows in found.values():
        console.print(
            benchmark_arm.arm_table({"batch": 2, "machine": {"cores": 2}, "engines": rows})
        )
    text = console.export_text()
    assert all(text.count(name) == 2 for name in (OURS, PHYSICS, PEER))
    assert text.count("missed") == 1
