"""Checkpoints: a pytree and its configuration in one folder, whole and checked, or not there.

A checkpoint is a folder:

    arrays/         the array leaves, by Orbax, under flat names such as "params/dense_0/bias"
    metadata.json   what the caller says about the tree (its configuration), and each leaf's kind
    manifest.json   the SHA-256 and the size of every other file, and a digest of itself

It is written into a sibling folder and renamed into place when complete. The checkpoint that it
replaces is set aside before that rename and deleted after it, so that a process killed at any
moment leaves the old checkpoint or the new one; `restore` finds whichever it is.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

_ARRAYS, _METADATA, _MANIFEST = "arrays", "metadata.json", "manifest.json"
_REMEDY = "delete that folder and run the same command again to make it anew"


class CheckpointError(Exception):
    """A checkpoint cannot be used; the message says in one line which one, why, and the remedy."""


class MissingCheckpoint(CheckpointError):
    """There is no finished checkpoint at the path."""


class DamagedCheckpoint(CheckpointError):
    """A file of the checkpoint is missing or differs from what was written."""


class MismatchedCheckpoint(CheckpointError):
    """The checkpoint is sound, but its tree is not the one that was asked for."""


def save(path: str | Path, tree: Any, metadata: Mapping[str, Any] | None = None) -> None:
    """Writes a pytree to the folder `path`, replacing a checkpoint that is already there.

    Args:
        path: the folder to write; its parents are made.
        tree: a pytree of arrays, typed keys, Python numbers and None.
        metadata: anything that JSON holds, such as the configuration; see `read_metadata`.

    Raises:
        ValueError: a leaf is of another type, or a dictionary key contains "/".
        FileExistsError: a folder with something else than a checkpoint is at `path`.
    """
    path = _absolute(path)
    arrays, leaves = _split(tree)
    if path.exists() and not (path / _MANIFEST).is_file() and any(path.iterdir()):
        raise FileExistsError(f"{path} is not a checkpoint: it will not be overwritten")
    path.parent.mkdir(parents=True, exist_ok=True)
    writing, previous = _writing(path), _previous(path)
    shutil.rmtree(writing, ignore_errors=True)
    writing.mkdir()
    if arrays:
        _write_arrays(writing / _ARRAYS, arrays)
    described = {"metadata": dict(metadata or {}), "leaves": leaves}
    _write_text(writing / _METADATA, json.dumps(described, indent=1, allow_nan=False))
    _write_text(writing / _MANIFEST, _manifest_text(_digests(writing)))
    if path.exists():
        _discard(previous)
        path.rename(previous)
    writing.rename(path)
    _sync(path.parent)
    _discard(previous)


def restore(path: str | Path, like: Any = None) -> Any:
    """Reads a pytree back, after checking every file against the manifest.

    Args:
        path: the folder given to `save`.
        like: a tree of the wanted structure. Its leaves are arrays or `jax.ShapeDtypeStruct`s,
            whose shapes and dtypes must be those saved, or Python numbers, typed keys and None.

    Returns:
        The tree in the structure of `like`: NumPy arrays where `like` has them, JAX arrays on the
        default device elsewhere. Without `like`: nested dictionaries of NumPy arrays, in which
        the items of a sequence are called "0", "1", …. Typed keys and Python numbers come back
        as what they were.

    Raises:
        MissingCheckpoint: there is no finished checkpoint.
        DamagedCheckpoint: a file is missing or changed; the message names it.
        MismatchedCheckpoint: the tree differs from `like`; the message names the first leaf.
    """
    folder = _find(path)
    leaves = _verified_description(folder)["leaves"]
    values = {name: _scalar(leaf) for name, leaf in leaves.items()}
    stored = [name for name, leaf in leaves.items() if leaf["kind"] in ("array", "key")]
    if stored:
        arrays = _read_arrays(folder / _ARRAYS, stored)
        for name in stored:
            values[name] = np.asarray(arrays[name])
            if leaves[name]["kind"] == "key":
                values[name] = jax.random.wrap_key_data(
                    jax.numpy.array(values[name]), impl=leaves[name]["implementation"]
                )
    return _nest(values) if like is None else _arrange(values, like, folder)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata given to `save`, after the same check as `restore`, with the same errors."""
    return _verified_description(_find(path))["metadata"]


def exists(path: str | Path) -> bool:
    """Whether a finished checkpoint is at `path`; its content is not checked."""
    path = _absolute(path)
    return any((folder / _MANIFEST).is_file() for folder in (path, _previous(path)))


def _split(tree: Any) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """The arrays by flat name, as NumPy arrays, and the description of every leaf."""
    arrays, leaves = {}, {}
    for name, value in _named_leaves(tree):
        if name in leaves:
            raise ValueError(f"two leaves of the tree are called '{name}': rename one")
        if value is None or isinstance(value, bool | int | float):
            leaves[name] = {"kind": type(value).__name__, "value": _json_number(value)}
        elif isinstance(value, jax.Array) and jax.dtypes.issubdtype(
            value.dtype, jax.dtypes.prng_key
        ):
            arrays[name] = np.asarray(jax.random.key_data(value))
            leaves[name] = {"kind": "key", "implementation": str(jax.random.key_impl(value))}
        elif isinstance(value, jax.Array | np.ndarray | np.generic) and value.dtype != object:
            array = np.asarray(value)
            kind = "array" if array.size else "empty"
            leaves[name] = {"kind": kind, "shape": list(array.shape), "dtype": array.dtype.name}
            if array.size:  # Orbax refuses arrays of size zero.
                arrays[name] = array
        else:
            raise ValueError(
                f"leaf '{name}' is a {type(value).__name__}: a checkpoint holds arrays, typed "
                "keys, numbers and None; put anything else into the metadata"
            )
    return arrays, leaves


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Each leaf, None included, with the names on the way to it joined by "/"."""
    flat, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda leaf: leaf is None)
    return [("/".join(_step_name(step) for step in steps), leaf) for steps, leaf in flat]


def _step_name(step: Any) -> str:
    for attribute in ("name", "key", "idx"):
        if hasattr(step, attribute):
            name = str(getattr(step, attribute))
            if "/" in name:
                raise ValueError(f"the tree's key '{name}' contains '/': rename it")
            return name
    raise ValueError(f"a tree with steps of type {type(step).__name__} cannot be saved")


def _json_number(value: float | None) -> Any:
    """JSON has no infinities and no NaN; `float` reads their names back."""
    return repr(value) if isinstance(value, float) and not np.isfinite(value) else value


def _scalar(leaf: Mapping[str, Any]) -> Any:
    """The value of a leaf that the description holds by itself."""
    if leaf["kind"] == "empty":
        return np.zeros(leaf["shape"], np.dtype(leaf["dtype"]))
    if leaf["kind"] == "float":
        return float(leaf["value"])
    return leaf.get("value")


def _nest(values: Mapping[str, Any]) -> Any:
    if "" in values and len(values) == 1:
        return values[""]
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *folders, last = name.split("/")
        inner = nested
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = value
    return nested


def _arrange(values: Mapping[str, Any], like: Any, folder: Path) -> Any:
    wanted = _named_leaves(like)
    names = [name for name, _ in wanted]
    missing = [name for name in names if name not in values]
    surplus = [name for name in values if name not in set(names)]
    if missing or surplus:
        what = f"lacks the leaf '{missing[0]}'" if missing else f"has a leaf '{surplus[0]}' more"
        raise MismatchedCheckpoint(
            f"checkpoint {folder} {what}: it was made by other code or settings; {_REMEDY}"
        )
    leaves = [_fit(values[name], template, name, folder) for name, template in wanted]
    structure = jax.tree_util.tree_structure(like, is_leaf=lambda leaf: leaf is None)
    return jax.tree_util.tree_unflatten(structure, leaves)


def _fit(value: Any, template: Any, name: str, folder: Path) -> Any:
    """One restored leaf in the form of its template."""
    if (found := _form(value)) != (expected := _form(template)):
        raise MismatchedCheckpoint(
            f"leaf '{name}' of checkpoint {folder} is {found}, expected {expected}: it was made "
            f"by other code or settings; {_REMEDY}"
        )
    if isinstance(template, np.generic):
        return value[()]
    if isinstance(value, np.ndarray) and not isinstance(template, np.ndarray):
        return jax.numpy.array(value)
    return value


def _form(leaf: Any) -> str:
    if hasattr(leaf, "dtype") and hasattr(leaf, "shape"):
        return f"{leaf.dtype}[{', '.join(str(size) for size in leaf.shape)}]"
    return "None" if leaf is None else f"a Python {type(leaf).__name__}"


def _find(path: str | Path) -> Path:
    """The finished checkpoint at `path`, or the one that an interrupted `save` had set aside."""
    path = _absolute(path)
    if (path / _MANIFEST).is_file():
        return path
    if not path.exists() and (_previous(path) / _MANIFEST).is_file():
        return _previous(path)
    if (path / _METADATA).is_file() or (path / _ARRAYS).is_dir():
        raise DamagedCheckpoint(f"checkpoint {path} is damaged: {_MANIFEST} is missing; {_REMEDY}")
    raise MissingCheckpoint(
        f"there is no finished checkpoint at {path}; run the command that makes it to its end"
    )


def _verified_description(folder: Path) -> dict[str, Any]:
    """metadata.json as written, once every file has been found to be as written."""
    written = _read_manifest(folder)
    found = _digests(folder)
    for name, description in written.items():
        if name not in found:
            raise DamagedCheckpoint(f"checkpoint {folder} is damaged: {name} is missing; {_REMEDY}")
        if found[name] != description:
            raise DamagedCheckpoint(
                f"checkpoint {folder} is damaged: {name} is not what was written; {_REMEDY}"
            )
    return json.loads((folder / _METADATA).read_text(encoding="utf-8"))


def _read_manifest(folder: Path) -> dict[str, dict]:
    text = (folder / _MANIFEST).read_bytes()
    try:
        files = json.loads(text)["files"]
        sound = _manifest_text(files).encode() == text
    except (ValueError, KeyError, TypeError):
        sound = False
    if not sound:
        raise DamagedCheckpoint(
            f"checkpoint {folder} is damaged: {_MANIFEST} is not what was written; {_REMEDY}"
        )
    return files


def _manifest_text(files: Mapping[str, dict]) -> str:
    digest = hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()
    return json.dumps({"files": files, "sha256": digest}, indent=1, sort_keys=True)


def _digests(folder: Path) -> dict[str, dict]:
    """SHA-256 and size in bytes of every file below the folder but the manifest."""
    digests = {}
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder).as_posix()
        if file.is_file() and name != _MANIFEST:
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            digests[name] = {"bytes": file.stat().st_size, "sha256": digest}
    return digests


# Orbax takes a second to import, which a command without checkpoints can save.


def _write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    from orbax.checkpoint import Checkpointer, PyTreeCheckpointHandler

    with Checkpointer(PyTreeCheckpointHandler()) as checkpointer:
        checkpointer.save(path, arrays)


def _read_arrays(path: Path, names: Sequence[str]) -> Mapping[str, np.ndarray]:
    from orbax.checkpoint import Checkpointer, PyTreeCheckpointHandler, RestoreArgs

    as_numpy = {name: RestoreArgs(restore_type=np.ndarray) for name in names}
    with Checkpointer(PyTreeCheckpointHandler()) as checkpointer:
        return checkpointer.restore(path, restore_args=as_numpy)


def _absolute(path: str | Path) -> Path:
    return Path(os.path.abspath(Path(path).expanduser()))


def _writing(path: Path) -> Path:
    return path.with_name(f".{path.name}.writing")


def _previous(path: Path) -> Path:
    return path.with_name(f".{path.name}.previous")


def _discard(previous: Path) -> None:
    """Deletes a checkpoint, its manifest first: half deleted, it must not be taken for one."""
    (previous / _MANIFEST).unlink(missing_ok=True)
    shutil.rmtree(previous, ignore_errors=True)


def _write_text(file: Path, text: str) -> None:
    with file.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
