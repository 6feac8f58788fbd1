"""The players of a run in one file, so that others can put a method beside the very same partners.

The same seed makes other partners on another machine, whose sums are ordered differently. Who wants
to compare with recorded results needs the partners themselves: those to learn with, those held out,
the best responses and the task language, in half precision where numbers are large in number. What
only a run can make anew is not in it: critics, the egos that learnt beside the partners, the policy
VAE and all behind it.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import traverse_util
from safetensors import SafetensorError, safe_open

from experiments.configs import RunConfig
from experiments.errors import UserError
from experiments.stages import (
    Archive,
    Run,
    load_archive,
    load_population,
    load_task_language,
    population_shapes,
)
from haland_jax import checkpoint
from haland_jax.partners import Population

_FORMAT = "1"
_POLICIES = ("partners", "egos", "oracles")
_INDICES = ("train_index", "held_out_index", "known_index")


def packed(run: Run) -> bytes:
    """The players of a run whose first stages are finished, as a safetensors file."""
    population, archive = load_population(run), load_archive(run)
    language = load_task_language(run)
    arrays = {
        "partners": population.partners,
        "egos": archive.egos.actor,
        "oracles": archive.oracles,
        "returns": {"joint": population.joint_returns, "oracle": archive.oracle_returns},
        "indices": {name: getattr(population, name) for name in _INDICES},
        "language": {
            "v_hat": language.v_hat, "by_seed": language.v_hat_by_seed, "scale": language.scale
        },
    }  # fmt: skip
    # Policies that took up a normalisation have weights of several magnitudes.
    exact = run.config.partners.joint.normalise
    flat = {
        name: _stored(name, np.asarray(leaf), exact)
        for name, leaf in traverse_util.flatten_dict(arrays, sep="/").items()
    }
    about = {
        "format": _FORMAT,
        "config": json.dumps(run.folder.configuration),
        "events": json.dumps(list(language.event_names)),
        "dropped": json.dumps(list(language.dropped_event_names)),
    }
    return _in_order(safetensors.numpy.save(flat, about))


def _in_order(file: bytes) -> bytes:
    """A safetensors file whose texts are sorted, so that the same players make the same file."""
    end = 8 + int.from_bytes(file[:8], "little")
    header = json.loads(file[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    return file[:8] + text.ljust(end - 8) + file[end:]


def _stored(name: str, array: np.ndarray, exact: bool) -> np.ndarray:
    if exact or name.split("/")[0] not in _POLICIES:
        return array
    fits = np.abs(array).max() <= np.finfo(np.float16).max
    return array.astype(np.float16) if fits else array


def read(file: Path) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """What `packed` wrote: nested arrays, and the texts beside them.

    Raises:
        UserError: the file is missing, damaged or of another version.
    """
    if not file.is_file():
        raise UserError(
            f"{file} is missing; name a record that has players (python -m experiments.record RUN "
            "--players)"
        )
    try:
        with safe_open(file, "np") as opened:
            about = opened.metadata() or {}
            flat = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        if about.get("format") != _FORMAT:
            raise UserError(f"{file} has the format {about.get('format')}; expected {_FORMAT}")
        texts = {name: json.loads(about[name]) for name in ("config", "events", "dropped")}
    except (SafetensorError, KeyError, ValueError) as error:
        raise UserError(f"{file} is damaged ({error}); fetch it again") from error
    wide = {
        name: leaf.astype(np.float32) if leaf.dtype == np.float16 else leaf
        for name, leaf in flat.items()
    }
    return traverse_util.unflatten_dict(wide, sep="/"), texts


def expect_same_run(
    record: Path, arrays: Mapping[str, Any], config: RunConfig, results: Mapping[str, Any]
) -> None:
    """Checks that a record's players are those that its results are of.

    Raises:
        UserError: they are another run's.
    """
    there = results["environment"], results["preset"], results["seed"]
    same = there == (config.environment, config.preset, config.seed)
    joint = list(results["partners"]["joint_returns"].values())
    if not same or not np.allclose(joint, arrays["returns"]["joint"], rtol=1e-5):
        raise UserError(
            f"{record} has the players of another run than its results are of; record the run "
            "again, with --players"
        )


def unpack_into(run: Run, arrays: Mapping[str, Any], texts: Mapping[str, Any]) -> None:
    """Writes the checkpoints of a run's first stages from what `read` returned.

    What the file does not hold, critics and the egos of pairs, is NaN: nobody plays with it by
    mistake.
    """
    unknown = jax.tree.map(
        lambda leaf: np.full(leaf.shape, np.nan, leaf.dtype), population_shapes(run).egos
    )
    population = Population(
        partners=arrays["partners"],
        egos=unknown,
        joint_returns=arrays["returns"]["joint"],
        **{name: jnp.asarray(arrays["indices"][name]) for name in _INDICES},
    )
    archive = Archive(
        egos=population.train_egos.replace(actor=arrays["egos"]),
        oracles=arrays["oracles"],
        oracle_returns=arrays["returns"]["oracle"],
    )
    names = {name: texts[name] for name in ("events", "dropped")}
    checkpoint.save(run.path("partners", "population"), population)
    checkpoint.save(run.path("best_responses", "archive"), archive)
    checkpoint.save(run.path("task_language", "language"), arrays["language"], names)
