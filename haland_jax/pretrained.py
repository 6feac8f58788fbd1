"""Trained models: a generator of policies, with held-out partners to try them with.

Some come with the package, one for each environment:

    model = pretrained.load("overcooked/diverse_coordination")
    ego = model.haland.generate("I cook on the left and leave the onions to you.", key)

A bundle is a folder:

    config.json           environment, sizes, events, and which encoder was fine-tuned
    arrays.safetensors    all parameters that deployment needs, see `haland_jax.compact`; of the
                          encoder only the difference of what fine-tuning changed
    card.md               where it comes from, and what was lost by storing it compactly
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import traverse_util
from safetensors import SafetensorError

import envs
from haland_jax import bert_weights, compact, policy_vae
from haland_jax.bert_weights import Encoder
from haland_jax.checkpoint import CheckpointError
from haland_jax.configuration import filled
from haland_jax.deployment import Haland
from haland_jax.diffusion import DiffusionConfig, DiffusionParams, LatentStatistics
from haland_jax.hypernetwork import PolicyArchitecture
from haland_jax.networks import Policy
from haland_jax.policy_vae import PolicyVAEConfig
from haland_jax.translator import Translator, TranslatorConfig

FOLDER = Path(str(resources.files("haland_jax"))) / "bundles"
"""Where the bundles that come with the package lie, by environment name."""

CONFIGURATION, ARRAYS = "config.json", "arrays.safetensors"
_FORMAT = 1


class BundleError(CheckpointError):
    """A bundle is damaged, or does not belong to this version, environment or encoder."""


@dataclasses.dataclass(frozen=True)
class TrainedModel:
    """A trained generator of policies and partners that no part of it has met.

    Attributes:
        env: the environment that it was trained in.
        haland: sentence to policy.
        held_out_partners: actors of partners, leading axes [style, seed].
        oracles: the best ego known for each of them, actors [style, seed].
        event_names: names of the task language's dimensions, U of them.
        event_scale: events a step that 1 stands for in the task language, float32 [U].
        universal: egos for partners of all styles, which are told nothing, actors [seed]; None
            where there are none.
    """

    env: Any
    haland: Haland
    held_out_partners: Policy
    oracles: Policy
    event_names: tuple[str, ...]
    event_scale: jax.Array
    universal: Policy | None = None

    @property
    def held_out_seeds(self) -> int:
        """Number of held-out partners of each style."""
        return jax.tree.leaves(self.held_out_partners)[0].shape[1]

    def partner(self, style: str, seed: int = 0) -> Policy:
        """A held-out partner of a style.

        Raises:
            ValueError: unknown style or no such seed.
        """
        if style not in self.env.style_names:
            raise ValueError(
                f"unknown style {style!r}; expected one of {', '.join(self.env.style_names)}"
            )
        if not 0 <= seed < self.held_out_seeds:
            raise ValueError(f"seed is {seed}; expected 0 to {self.held_out_seeds - 1}")
        index = self.env.style_names.index(style)
        return jax.tree.map(lambda leaf: leaf[index, seed], self.held_out_partners)


def names() -> tuple[str, ...]:
    """Environments whose bundle comes with the package."""
    found = FOLDER.glob(f"*/*/{CONFIGURATION}")
    return tuple(sorted(file.parent.relative_to(FOLDER).as_posix() for file in found))


def load(environment: str) -> TrainedModel:
    """The trained model that comes with the package for an environment.

    Raises:
        ValueError: none comes with the package; the message lists those that do.
        BundleError, EncoderWeightsError: as `read`.
    """
    if environment not in names():
        raise ValueError(
            f"there is no pretrained model of {environment!r}; expected one of "
            f"{', '.join(names())}, or train one: python -m experiments.run --env {environment}"
        )
    return read(FOLDER / environment)


def write(
    folder: Path, model: TrainedModel, encoder: Encoder, about: Mapping[str, Any]
) -> dict[str, int]:
    """Writes a model as a bundle.

    Args:
        folder: made if it is not there; files of an earlier bundle in it are replaced.
        model: what to write.
        encoder: the pre-trained encoder that the model's translator was fine-tuned from.
        about: anything else for config.json, under "about", such as the run's configuration.
            `about["encoder"]` is the encoder's name on the hub, empty for the packaged one.

    Returns:
        Size in bytes of each part's arrays.
    """
    haland = model.haland
    parts = {
        "decoder": haland.vae_params["params"]["decoder"],
        "diffusion": haland.diffusion_params.network["params"],
        "latents": {
            "mean": haland.diffusion_params.statistics.mean,
            "std": haland.diffusion_params.statistics.std,
        },
        "encoder": _difference(encoder, haland.translator.params["encoder"]),
        "classifier": haland.translator.params["classifier"],
        "translation": haland.translator.params["vae"],
        "held_out_partners": model.held_out_partners["params"],
        "oracles": model.oracles["params"],
        "language": {"v_hat": haland.v_hat, "scale": model.event_scale},
    }
    if model.universal is not None:
        parts["universal"] = model.universal["params"]
    exact = ()
    if policy_vae.STATISTICS in haland.vae_params:
        parts["observations"] = haland.vae_params[policy_vae.STATISTICS]
        # Where a number hardly varies, their weights are a hundred times larger than the others.
        exact = ("held_out_partners", "oracles", "universal")
    packed = compact.pack(parts, exact)
    folder.mkdir(parents=True, exist_ok=True)
    safetensors.numpy.save_file(packed, folder / ARRAYS)
    configuration = {
        "format": _FORMAT,
        "environment": model.env.name,
        "max_steps": model.env.max_steps,
        "styles": list(model.env.style_names),
        "events": list(model.event_names),
        "vae": dataclasses.asdict(haland.vae_config),
        "diffusion": dataclasses.asdict(haland.diffusion_config),
        "translator": dataclasses.asdict(haland.translator.config),
        "encoder_fingerprint": fingerprint(encoder),
        "arrays_sha256": _sha256(folder / ARRAYS),
        "about": dict(about),
    }
    text = json.dumps(configuration, indent=1, allow_nan=False) + "\n"
    (folder / CONFIGURATION).write_text(text, encoding="utf-8")
    sizes = dict.fromkeys(parts, 0)
    for name, array in packed.items():
        sizes[name.split("/")[0]] += array.nbytes
    return sizes


def read(folder: Path) -> TrainedModel:
    """The model in a bundle.

    Raises:
        BundleError: the bundle is damaged, made by another version, or was fine-tuned from
            another encoder than the one found.
        EncoderWeightsError: the encoder that it names is not there.
    """
    stored = _read_configuration(folder)
    parts = _read_arrays(folder, stored)
    try:
        env = envs.make(stored["environment"], max_steps=stored["max_steps"])
        source = stored["about"]["encoder"] or None
        diffusion_config = filled(DiffusionConfig(), stored["diffusion"])
        vae_config = filled(PolicyVAEConfig(), stored["vae"])
        # Bundles from before fine-tunings were averaged hold a single one, and do not say so.
        translator_config = filled(TranslatorConfig(), {"fine_tunings": 1} | stored["translator"])
        held_out, oracles = ({"params": parts[n]} for n in ("held_out_partners", "oracles"))
        architecture = PolicyArchitecture.from_params(oracles)
        _check_environment(folder, stored, env, architecture)
    except (KeyError, TypeError, ValueError) as error:
        raise BundleError(
            f"the bundle {folder} does not fit this version ({error}); export it again"
        ) from error
    encoder = bert_weights.load_encoder(source)
    if fingerprint(encoder) != stored["encoder_fingerprint"]:
        raise BundleError(
            f"the bundle {folder} was fine-tuned from another encoder than "
            f"{source or 'the packaged one'}, which is installed here; install that version, or "
            "train again"
        )
    vae_params = {"params": {"decoder": parts["decoder"]}}
    if "observations" in parts:
        vae_params[policy_vae.STATISTICS] = parts["observations"]
    statistics = LatentStatistics(parts["latents"]["mean"], parts["latents"]["std"])
    haland = Haland(
        architecture=architecture,
        vae_config=vae_config,
        vae_params=vae_params,
        diffusion_config=diffusion_config,
        diffusion_params=DiffusionParams({"params": parts["diffusion"]}, statistics),
        translator=Translator(
            params={
                "encoder": _changed(encoder, parts["encoder"]),
                "classifier": parts["classifier"],
                "vae": parts["translation"],
            },
            architecture=encoder.architecture,
            config=translator_config,
        ),
        tokenizer=bert_weights.load_tokenizer(source),
        style_names=env.style_names,
        v_hat=parts["language"]["v_hat"],
    )
    return TrainedModel(
        env=env,
        haland=haland,
        held_out_partners=held_out,
        oracles=oracles,
        event_names=tuple(stored["events"]),
        event_scale=parts["language"]["scale"],
        universal={"params": parts["universal"]} if "universal" in parts else None,
    )


def fingerprint(encoder: Encoder) -> str:
    """SHA-256 of an encoder's parameters, with their names and shapes."""
    digest = hashlib.sha256()
    flat: dict[str, Any] = traverse_util.flatten_dict(encoder.params["params"], sep="/")
    for name in sorted(flat):
        array = np.ascontiguousarray(flat[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _difference(encoder: Encoder, tuned: Mapping[str, Any]) -> dict[str, Any]:
    """Tuned minus pre-trained, for the parameters that fine-tuning changed."""
    before: dict[str, Any] = traverse_util.flatten_dict(encoder.params["params"], sep="/")
    after: dict[str, Any] = traverse_util.flatten_dict(dict(tuned), sep="/")
    if set(before) != set(after):
        raise ValueError("the model's encoder has other parameters than the pre-trained one")
    change = {name: np.asarray(after[name]) - np.asarray(before[name]) for name in before}
    return traverse_util.unflatten_dict({n: c for n, c in change.items() if c.any()}, sep="/")


def _changed(encoder: Encoder, difference: Mapping[str, Any]) -> dict[str, Any]:
    """The pre-trained parameters plus the difference, where there is one."""
    params: dict[str, Any] = traverse_util.flatten_dict(encoder.params["params"], sep="/")
    change: dict[str, Any] = traverse_util.flatten_dict(dict(difference), sep="/")
    tuned = {name: params[name] + change[name] for name in change}
    return traverse_util.unflatten_dict({**params, **tuned}, sep="/")


def _read_configuration(folder: Path) -> dict[str, Any]:
    try:
        stored = json.loads((folder / CONFIGURATION).read_text(encoding="utf-8"))
        found = stored["format"]
    except OSError as error:
        raise BundleError(f"there is no bundle at {folder} ({error.strerror})") from None
    except (ValueError, KeyError, TypeError):
        raise BundleError(
            f"the bundle {folder} is damaged: {CONFIGURATION} is not what was written"
        ) from None
    if found != _FORMAT:
        raise BundleError(
            f"the bundle {folder} has the format {found}, this version reads {_FORMAT}; "
            "export it again"
        )
    return stored


def _read_arrays(folder: Path, stored: Mapping[str, Any]) -> dict[str, Any]:
    path = folder / ARRAYS
    if not path.is_file():
        raise BundleError(f"the bundle {folder} is damaged: {ARRAYS} is missing")
    if _sha256(path) != stored.get("arrays_sha256"):
        raise BundleError(
            f"the bundle {folder} is damaged: {ARRAYS} is not what was written; get it again"
        )
    try:
        packed = safetensors.numpy.load_file(path)
    except SafetensorError as error:
        raise BundleError(f"{path} is no readable safetensors file: {error}") from error
    return jax.tree.map(jnp.asarray, compact.unpack(packed))


def _check_environment(
    folder: Path, stored: Mapping[str, Any], env: Any, architecture: PolicyArchitecture
) -> None:
    """Raises BundleError if the environment is not the one that the model was trained in."""
    here = (list(env.style_names), env.observation_sizes.ego, env.num_actions.ego)
    there = (stored["styles"], architecture.observation_dim, architecture.action_dim)
    for what, now, then in zip(("styles", "observation", "actions"), here, there, strict=True):
        if now != then:
            raise BundleError(
                f"the bundle {folder} was made for another version of {stored['environment']}: "
                f"its {what} were {then}, now {now}; train and export it again"
            )


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
