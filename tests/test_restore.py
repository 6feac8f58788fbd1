"""Records with players: a run made of one plays with the very same partners."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from refused_command import refused

from experiments import compare, record, restore
from experiments.compared import PLAYERS
from experiments.errors import UserError
from experiments.finished_run import open_run
from experiments.restore import RESTORED
from experiments.stages import load_archive, load_population, load_task_language
from haland_jax import partners

EXAMPLE = Path(__file__).parent.parent / "docs" / "examples" / "retrieval.py"
pytestmark = pytest.mark.light_compilation


@pytest.fixture(scope="module")
def recorded(smoke_run, tmp_path_factory):
    """A record of the smoke run, in which a method of somebody's own was measured."""
    folder = tmp_path_factory.mktemp("recorded")
    run = Path(shutil.copytree(smoke_run, folder / "run"))
    compare.measure(run, (), added=EXAMPLE)
    record.record([run], folder / "out", None, players=True)
    (found,) = (folder / "out").rglob(PLAYERS)
    return run, found.parent


@pytest.fixture(scope="module")
def restored(recorded, tmp_path_factory):
    return restore.restore(recorded[1], tmp_path_factory.mktemp("restored") / "run")


def assert_near(one, two):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_partners_and_best_responses_are_those_of_the_run(recorded, restored):
    was, now = (open_run(path, RESTORED) for path in (recorded[0], restored))
    assert now.config == was.config
    before, after = load_population(was), load_population(now)
    for name in ("train_index", "held_out_index", "known_index", "joint_returns"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert_near(after.held_out_partners, before.held_out_partners)
    teachers = [
        partners.teachers(run.env, run.config.partners, population)
        for run, population in ((was, before), (now, after))
    ]
    assert_near(*teachers)
    assert_near(load_archive(now).egos.actor, load_archive(was).egos.actor)
    assert_near(load_archive(now).oracles, load_archive(was).oracles)
    one, two = load_task_language(now), load_task_language(was)
    assert (one.event_names, one.dropped_event_names) == (two.event_names, two.dropped_event_names)
    np.testing.assert_array_equal(one.v_hat, two.v_hat)
    for unknown in jax.tree.leaves(after.egos):
        assert np.isnan(unknown).all(), "what is not recorded is nothing to play with"


@pytest.mark.slow
def test_a_method_joins_the_recorded_ones(recorded, restored, tmp_path):
    was = json.loads((recorded[1] / "results.json").read_text())
    assert json.loads((restored / "results.json").read_text()) == was
    mine = tmp_path / "mine.py"
    mine.write_text(
        EXAMPLE.read_text().replace("Retrieval", "Mine").replace('"retrieval"', '"mine"')
    )
    results = compare.measure(restored, (), added=mine)
    for name, by_style in was["methods"].items():
        assert results["methods"][name] == by_style, "the recorded methods stay"
    assert {"Retrieval", "Mine"} <= set(results["descriptions"])
    # The same best responses with the same partners, in other games.
    means = [
        np.mean([np.mean(style["returns"]) for style in results["methods"][name].values()])
        for name in ("Retrieval", "Mine")
    ]
    assert np.isfinite(means).all()
    assert "| Mine |" in (restored / "report.md").read_text()


@pytest.mark.slow
def test_what_a_record_does_not_hold_is_refused(capsys, monkeypatch, recorded, restored, tmp_path):
    with pytest.raises(
        UserError, match=r"'no-vae' is Haland without a part, and the run in .* has no"
    ):
        compare.measure(restored, ("no-vae",))
    line = refused(capsys, monkeypatch, restore, recorded[1], "--out", restored)
    assert "is there already; remove it" in line
    line = refused(capsys, monkeypatch, restore, tmp_path)
    assert "players.safetensors is missing; name a record that has players" in line
    damaged = Path(shutil.copytree(recorded[1], tmp_path / "damaged"))
    (damaged / PLAYERS).write_bytes(b"nothing")
    line = refused(capsys, monkeypatch, restore, damaged, "--out", tmp_path / "run")
    assert "is damaged" in line
    assert not (tmp_path / "run").exists()
