"""Records with players: a run made of one plays with the very same partners."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import safetensors.numpy
from refused_command import refused
from safetensors import safe_open

from experiments import compare, pipeline, players, record, restore
from experiments.compared import PLAYER_STAGES, PLAYERS
from experiments.errors import UserError
from experiments.finished_run import configuration_from, open_run
from experiments.stages import load_archive, load_population, load_task_language
from haland_jax import mirrors

DOCS = Path(__file__).parent.parent / "docs"
EXAMPLE = DOCS / "examples" / "retrieval.py"


@pytest.fixture(scope="module")
def recorded(smoke_run, tmp_path_factory, no_drawing):
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
    was, now = (open_run(path, PLAYER_STAGES) for path in (recorded[0], restored))
    assert now.config == was.config
    before, after = load_population(was), load_population(now)
    for name in ("train_index", "held_out_index", "known_index", "joint_returns"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert_near(after.held_out_partners, before.held_out_partners)
    teachers = [
        mirrors.teachers(run.env, run.config.partners, population)
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
    assert results["methods"].pop("Mine").keys() == set(was["styles"])
    assert set(results["compared"].pop("mine")["by_ego"]) == {"Mine"}
    del results["descriptions"]["Mine"]
    assert results == was, "what was recorded stays"
    assert "| Mine |" in (restored / "report.md").read_text()
    gif = f"figures/episodes/{was['styles'][0]}.gif"
    assert (restored / gif).read_bytes() == (recorded[1] / gif).read_bytes()


@pytest.mark.slow
def test_what_a_record_does_not_hold_is_refused(capsys, monkeypatch, recorded, restored, tmp_path):
    for ask in (
        lambda: compare.measure(restored, ("no-vae",)),
        lambda: pipeline.run_pipeline(open_run(restored, PLAYER_STAGES).config, restored),
    ):
        with pytest.raises(
            UserError, match=r"was made of the record .* and no 'universal'; make a"
        ):
            ask()
    line = refused(capsys, monkeypatch, restore, recorded[1], "--out", restored)
    assert "is there already; remove it" in line
    line = refused(capsys, monkeypatch, restore, tmp_path)
    assert "players.safetensors is missing; name a record that has players" in line
    results = json.loads((recorded[1] / "results.json").read_text())
    results["partners"]["joint_returns"][results["styles"][0]][0] += 1.0
    for name, content, said in (
        (PLAYERS, b"nothing", "is damaged"),
        ("results.json", b"nothing", "results.json is damaged"),
        ("results.json", json.dumps(results).encode(), "has the players of another run"),
    ):
        bad = Path(shutil.copytree(recorded[1], tmp_path / "bad", dirs_exist_ok=True))
        (bad / name).write_bytes(content)
        line = refused(capsys, monkeypatch, restore, bad, "--out", tmp_path / "run")
        assert said in line
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "record_folder",
    sorted(file.parent.relative_to(DOCS) for file in (DOCS / "comparisons").rglob(PLAYERS)),
    ids=str,
)
def test_the_records_of_the_repository_fit_this_version(record_folder):
    # Whatever settings have been added since, a record says of them what was done.
    _, texts = players.read(DOCS / record_folder / PLAYERS)
    config = configuration_from(record_folder, texts["config"])
    assert config.environment == "/".join(record_folder.parts[1:])
    if "guidance" not in texts["config"]["universal"]["training"]:
        assert config.universal.training.guidance == 0
    if "universal_rate" not in texts["config"]["partners"]:
        assert config.partners.universal_refit == config.partners.refit
    if "fine_tunings" not in texts["config"]["translator"]:
        assert config.translator.fine_tunings == 1


def test_half_precision_is_for_policies_that_fit_into_it():
    policy = np.array([[0.1, 2.0], [300.0, -4.0]], np.float32)
    assert players._stored("partners/kernel", policy, False).dtype == np.float16
    for name, array, exact in (
        ("partners/kernel", policy, True),
        ("partners/kernel", policy * 1000, False),
        ("language/by_seed", policy, False),
    ):
        np.testing.assert_array_equal(players._stored(name, array, exact), array)


def test_the_same_players_make_the_same_file(tmp_path):
    arrays = {"a/b": np.arange(6.0).reshape(2, 3), "a/c": np.ones(2, np.float16)}
    about = {name: f'{{"{name}": "é"}}' for name in ("format", "config", "events", "dropped")}
    files = {players._in_order(safetensors.numpy.save(arrays, about)) for _ in range(8)}
    assert len(files) == 1
    (tmp_path / PLAYERS).write_bytes(files.pop())
    with safe_open(tmp_path / PLAYERS, "np") as opened:
        assert opened.metadata() == about
        for name, array in arrays.items():
            np.testing.assert_array_equal(opened.get_tensor(name), array)
