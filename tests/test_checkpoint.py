"""Checkpoints come back exactly, say which file is damaged, and survive being killed."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from haland_jax import checkpoint


class TrainingState(struct.PyTreeNode):
    step: jax.Array
    key: jax.Array
    params: dict
    optimizer_state: Any


class Moments(NamedTuple):
    mean: np.ndarray
    count: int
    scale: float | None


@pytest.fixture
def state() -> TrainingState:
    params = {
        "dense_0": {"kernel": jnp.arange(6.0).reshape(2, 3), "bias": jnp.ones(3, jnp.bfloat16)}
    }
    moments = Moments(mean=np.linspace(0.0, 1.0, 5), count=7, scale=None)
    return TrainingState(
        step=jnp.int32(12),
        key=jax.random.split(jax.random.key(3), 4),
        params=params,
        optimizer_state=[moments, (), {"empty": jnp.zeros((0, 4)), "flag": True}, float("inf")],
    )


def zeros_like(tree: Any) -> Any:
    """The same structure with other values, so that a restored value is not one left in place."""

    def clear(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.split(jax.random.key(99), leaf.shape)
        return type(leaf)(0) if isinstance(leaf, int | float) else leaf * 0

    return jax.tree.map(clear, tree)


def test_everything_comes_back_in_its_structure_type_and_value(tmp_path, state):
    checkpoint.save(tmp_path / "fit", state, {"learning_rate": 1e-4, "hidden": [64, 64]})
    restored = checkpoint.restore(tmp_path / "fit", zeros_like(state))

    assert jax.tree.structure(restored) == jax.tree.structure(state)
    chains = jax.random.key_data(restored.key), jax.random.key_data(state.key)
    np.testing.assert_array_equal(*chains)
    assert restored.key.dtype == state.key.dtype
    for found, expected in zip(
        jax.tree.leaves(restored.replace(key=None)),
        jax.tree.leaves(state.replace(key=None)),
        strict=True,
    ):
        assert type(found) is type(expected)
        np.testing.assert_array_equal(found, expected)
        if not isinstance(expected, int | float):
            assert found.dtype == expected.dtype
    assert restored.optimizer_state[0].scale is None
    assert checkpoint.read_metadata(tmp_path / "fit") == {
        "learning_rate": 1e-4,
        "hidden": [64, 64],
    }


def test_without_a_template_the_tree_comes_back_as_nested_dictionaries(tmp_path, state):
    checkpoint.save(tmp_path / "fit", state)
    tree = checkpoint.restore(tmp_path / "fit")
    assert isinstance(tree["params"]["dense_0"]["kernel"], np.ndarray)
    np.testing.assert_array_equal(
        tree["params"]["dense_0"]["kernel"], [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    )
    assert tree["optimizer_state"]["0"]["count"] == 7
    assert tree["optimizer_state"]["2"]["empty"].shape == (0, 4)
    assert jax.random.uniform(tree["key"][2]) == jax.random.uniform(state.key[2])


def test_a_template_of_shapes_alone_is_enough(tmp_path, state):
    checkpoint.save(tmp_path / "fit", state.params)
    shapes = jax.eval_shape(lambda: state.params)
    restored = checkpoint.restore(tmp_path / "fit", shapes)
    assert isinstance(restored["dense_0"]["bias"], jax.Array)
    assert restored["dense_0"]["bias"].dtype == jnp.bfloat16


def test_dots_in_names_do_not_collide(tmp_path):
    tree = {"a.b": np.ones(2), "a": {"b": np.zeros(3)}, "partner:pickup@left": np.arange(4)}
    checkpoint.save(tmp_path / "names", tree)
    restored = checkpoint.restore(tmp_path / "names")
    assert restored["a.b"].shape == (2,)
    assert restored["a"]["b"].shape == (3,)
    np.testing.assert_array_equal(restored["partner:pickup@left"], np.arange(4))


def test_every_flipped_byte_and_every_missing_file_is_found_and_named(tmp_path):
    path, copy = tmp_path / "fit", tmp_path / "copy"
    checkpoint.save(path, {"weights": np.arange(12.0)}, {"name": "first"})
    files = sorted(file.relative_to(path) for file in path.rglob("*") if file.is_file())
    assert {"manifest.json", "metadata.json"} < {str(file) for file in files}
    for file in files:
        size = (path / file).stat().st_size
        for position in {0, size // 3, size // 2, size - 1} if size else ():
            shutil.copytree(path, copy)
            content = bytearray((copy / file).read_bytes())
            content[position] ^= 0x20
            (copy / file).write_bytes(content)
            with pytest.raises(checkpoint.DamagedCheckpoint, match=file.name):
                checkpoint.restore(copy)
            shutil.rmtree(copy)
        shutil.copytree(path, copy)
        (copy / file).unlink()
        with pytest.raises(checkpoint.DamagedCheckpoint, match=file.name):
            checkpoint.restore(copy)
        shutil.rmtree(copy)


def test_missing_and_unfinished_checkpoints_are_called_missing(tmp_path):
    with pytest.raises(checkpoint.MissingCheckpoint, match="nowhere"):
        checkpoint.restore(tmp_path / "nowhere")
    checkpoint.save(tmp_path / "fit", {"x": np.ones(2)})
    (tmp_path / "fit").rename(tmp_path / ".fit.writing")
    assert not checkpoint.exists(tmp_path / "fit")
    with pytest.raises(checkpoint.MissingCheckpoint):
        checkpoint.restore(tmp_path / "fit")


def test_killed_between_the_two_renames_the_old_checkpoint_is_found(tmp_path, monkeypatch):
    path = tmp_path / "fit"
    checkpoint.save(path, {"version": 1})
    rename = Path.rename

    def die_before_the_last_rename(self, target):
        if self.name.endswith(".writing"):
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", die_before_the_last_rename)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(path, {"version": 2})
    monkeypatch.undo()
    assert not path.exists()
    assert checkpoint.exists(path)
    assert checkpoint.restore(path) == {"version": 1}
    checkpoint.save(path, {"version": 3})
    assert checkpoint.restore(path) == {"version": 3}
    assert [entry.name for entry in tmp_path.iterdir()] == ["fit"]


_WRITER = """
import sys
import numpy as np
from haland_jax import checkpoint
for version in range(1, 10_000):
    checkpoint.save(sys.argv[1], {"version": version, "array": np.full(200_000, version)})
    print(version, flush=True)
"""


def test_a_writer_killed_at_any_moment_leaves_a_whole_checkpoint(tmp_path):
    path = tmp_path / "fit"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    with subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as writer:
        assert writer.stdout is not None
        reported = [int(writer.stdout.readline()) for _ in range(3)]
        time.sleep(0.017)
        writer.send_signal(signal.SIGKILL)
        reported += [int(line) for line in writer.stdout.read().split()]
    tree = checkpoint.restore(path)
    # The save after the last reported one may have come through before it was reported.
    assert tree["version"] in (reported[-1], reported[-1] + 1)
    np.testing.assert_array_equal(tree["array"], np.full(200_000, tree["version"]))


@pytest.mark.parametrize(
    ("like", "message"),
    [
        ({"x": np.ones(3)}, r"'x'.*float64\[2\], expected float64\[3\]"),
        ({"x": np.ones(2, np.float32)}, r"'x'.*expected float32\[2\]"),
        ({"x": np.ones(2), "y": np.ones(1)}, "lacks the leaf 'y'"),
        ({}, "leaf 'x' more"),
        ({"x": None}, "expected None"),
    ],
)
def test_another_tree_than_the_saved_one_is_refused(tmp_path, like, message):
    checkpoint.save(tmp_path / "fit", {"x": np.ones(2)})
    with pytest.raises(checkpoint.MismatchedCheckpoint, match=message):
        checkpoint.restore(tmp_path / "fit", like)


def test_what_cannot_be_saved_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="'name' is a str"):
        checkpoint.save(tmp_path / "fit", {"name": "left"})
    with pytest.raises(ValueError, match="contains '/'"):
        checkpoint.save(tmp_path / "fit", {"left/right": np.ones(1)})
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError):
        checkpoint.save(tmp_path, {"x": np.ones(1)})
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_small_tree_is_saved_and_restored_quickly(tmp_path):
    policy = {
        f"dense_{i}": {"kernel": np.ones((64, 64), np.float32), "bias": np.ones(64, np.float32)}
        for i in range(3)
    }
    checkpoint.save(tmp_path / "warm", policy)
    began = time.perf_counter()
    checkpoint.save(tmp_path / "policy", policy)
    checkpoint.restore(tmp_path / "policy", policy)
    assert time.perf_counter() - began < 1.0  # 0.05 s on an idle machine
