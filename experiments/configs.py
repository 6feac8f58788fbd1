"""The presets: everything that a run depends on, as frozen dataclasses."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

from experiments.adaptations import ADAPTATIONS, LONG_COMPRESSION, Adaptation, PresetChanges
from haland_jax.diffusion import DiffusionConfig
from haland_jax.fit import FitConfig
from haland_jax.partners import PartnersConfig, best_response_config, oracle_config
from haland_jax.policy_vae import PolicyVAEConfig
from haland_jax.ppo import PPOConfig
from haland_jax.translator import TranslatorConfig
from haland_jax.universal import UniversalConfig, universal_config

Settings = TypeVar("Settings")
DEFAULT_ENVIRONMENT = "overcooked/diverse_coordination"


@dataclasses.dataclass(frozen=True)
class CompressionConfig:
    """The policy VAE's fit.

    Attributes:
        vae: sizes and loss (Table 2).
        fit: optimiser and length.
        chunk_steps: steps that the fit takes on the same states, before fresh ones are drawn;
            divides `fit.steps`.
        own_states: states of each policy from games with the partners that egos of its style
            learn with.
        other_states: states from games with partners of other styles.
        decoded_states: states from games of the *decoded* policy, labelled by the original;
            they stop small errors from adding up along a game (DAgger, Ross et al., 2011).
        gate_games: games of each policy and partner in the gate.
    """

    vae: PolicyVAEConfig = dataclasses.field(default_factory=PolicyVAEConfig)
    fit: FitConfig = dataclasses.field(
        default_factory=lambda: FitConfig(learning_rate=1e-2, steps=2000, warmup_steps=50)
    )
    chunk_steps: int = 100
    own_states: int = 2048
    other_states: int = 512
    decoded_states: int = 1024
    gate_games: int = 64

    def __post_init__(self):
        if self.fit.steps % self.chunk_steps:
            raise ValueError(
                f"chunk_steps is {self.chunk_steps}; expected a divisor of fit.steps = "
                f"{self.fit.steps}"
            )


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """How generated policies are judged, with held-out partners only.

    Attributes:
        games: games of each pair of policies.
        samples: policies generated from each sentence, or each style's true task language.
        batch: pairs that play at once; the compiled program has this size.
    """

    games: int = 16
    samples: int = 2
    batch: int = 64


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Everything that the results of a run depend on.

    Attributes:
        environment: name in the registry.
        preset: name of the preset that this was made from.
        seed: of all randomness.
        max_steps: steps of a game.
        encoder: folder or hub name of a BERT checkpoint; empty for the packaged MiniLM.
        partners: partners and best responses (stage 1).
        task_language_games: games of each pair from which Eq. 8's frequencies are counted
            (stage 2).
        compression: policy VAE (stage 3).
        diffusion: latent diffusion (stage 4).
        training_sentences: at most so many of each style are used, evenly spread over the packaged
            ones; 0: all.
        translator: sentence translator (stage 5).
        universal: egos for the partners of all styles, told the style or not (stage 1).
        evaluation: what is measured (stage 6).
    """

    environment: str
    preset: str
    seed: int = 0
    max_steps: int = 400
    encoder: str = ""
    partners: PartnersConfig = dataclasses.field(default_factory=PartnersConfig)
    task_language_games: int = 32
    compression: CompressionConfig = dataclasses.field(default_factory=CompressionConfig)
    diffusion: DiffusionConfig = dataclasses.field(default_factory=DiffusionConfig)
    training_sentences: int = 0
    translator: TranslatorConfig = dataclasses.field(default_factory=TranslatorConfig)
    universal: UniversalConfig = dataclasses.field(default_factory=UniversalConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)

    def __post_init__(self):
        if self.training_sentences < 0:
            raise ValueError(
                f"training_sentences is {self.training_sentences}; expected 0 (all) or more"
            )


def _adapted(config: RunConfig) -> RunConfig:
    """Fits a preset to its environment."""
    change = ADAPTATIONS.get(config.environment, Adaptation())

    def changed(training: PPOConfig, length: float = 1.0, **more: Any) -> PPOConfig:
        steps = int(length * training.total_steps)
        return dataclasses.replace(training, total_steps=steps, **change.training, **more)

    of_preset = change.presets.get(config.preset, PresetChanges())
    partners, universal, compression = config.partners, config.universal, config.compression
    joint = changed(partners.joint, change.length, **change.joint)
    joint = _with(joint, total_steps=of_preset.joint_steps)
    training = _with(
        universal.training,
        num_envs=of_preset.universal_games,
        total_steps=of_preset.universal_start_steps,
    )
    partners = _with(
        partners,
        universal_start=None if of_preset.universal_start_steps is None else True,
        told_start=of_preset.told_start,
        spare_seeds=of_preset.spare_seeds,
    )
    normalised = change.training.get("normalise", compression.vae.normalised)
    return dataclasses.replace(
        config,
        max_steps=min(config.max_steps, change.max_steps),
        partners=dataclasses.replace(
            partners,
            joint=joint,
            refit=changed(partners.refit, change.refit_length, **change.refit),
            oracle=changed(partners.oracle),
            **change.partners,
        ),
        compression=dataclasses.replace(
            _with(compression, fit=of_preset.compression),
            vae=dataclasses.replace(compression.vae, normalised=normalised),
        ),
        translator=_with(config.translator, trainable_layers=of_preset.trainable_layers),
        universal=dataclasses.replace(universal, training=changed(training, **change.universal)),
    )


def _with(settings: Settings, **changes: Any) -> Settings:
    """A copy of a dataclass with those changes that are not None."""
    given = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(settings, **given)  # pyright: ignore[reportArgumentType]


_DIFFUSION = DiffusionConfig(clip=8.0, frequency_jitter=0.08)
"""What all presets but `smoke` sample and train with; they differ in the length of the fit."""


def smoke(environment: str, seed: int) -> RunConfig:
    """Every stage at toy size, to see that all of it works; nothing is learnt.

    `python -m experiments.run --preset smoke`; about two minutes on two CPU cores.
    """
    tiny = PPOConfig(total_steps=1280, num_envs=8, rollout_steps=20, num_minibatches=2, epochs=1)
    refit = dataclasses.replace(tiny, total_steps=640, shaping=0.0, confined_until=0.0)
    config = RunConfig(
        environment=environment,
        preset="smoke",
        seed=seed,
        max_steps=60,
        partners=PartnersConfig(
            train_seeds=2,
            held_out_seeds=1,
            spare_seeds=0,
            joint=tiny,
            refit=refit,
            oracle=refit,
            oracle_candidates=2,
            evaluation_games=4,
        ),
        task_language_games=4,
        compression=CompressionConfig(
            fit=FitConfig(learning_rate=1e-2, steps=40, warmup_steps=5),
            chunk_steps=20,
            own_states=64,
            other_states=32,
            decoded_states=32,
            gate_games=4,
        ),
        diffusion=DiffusionConfig(
            fit=FitConfig(learning_rate=3e-3, steps=40, warmup_steps=5, ema_decay=0.9),
            batch_size=16,
            ddim_steps=5,
            clip=8.0,
        ),
        training_sentences=8,
        translator=TranslatorConfig(
            fine_tunings=2,
            fine_tuning=FitConfig(learning_rate=1e-4, steps=4, warmup_steps=1),
            translation=FitConfig(learning_rate=1e-4, steps=20, warmup_steps=5),
        ),
        universal=UniversalConfig(
            seeds=2, training=dataclasses.replace(refit, num_envs=32, shaping=3.0)
        ),
        evaluation=EvaluationConfig(games=4, samples=1, batch=32),
    )
    return _adapted(config)


def quick(environment: str, seed: int) -> RunConfig:
    """The whole method with three training and two held-out seeds a style.

    `python -m experiments.run`; about a quarter of an hour on two CPU cores, up to an hour in other
    environments, where pairs or universal egos take longer.
    """
    config = RunConfig(
        environment=environment,
        preset="quick",
        seed=seed,
        partners=PartnersConfig(
            train_seeds=3,
            held_out_seeds=2,
            spare_seeds=1,
            joint=PPOConfig(total_steps=900_000),
            refit=best_response_config(400_000, num_envs=40),
            oracle=oracle_config(200_000),
            oracle_candidates=2,
            universal_start=False,
        ),
        compression=CompressionConfig(
            fit=FitConfig(learning_rate=1e-2, steps=1500, warmup_steps=50)
        ),
        diffusion=_DIFFUSION,
        universal=UniversalConfig(training=universal_config(1_500_000)),
    )
    return _adapted(config)


def overnight(environment: str, seed: int) -> RunConfig:
    """The scale of the recorded results: three training and three held-out seeds a style.

    `python -m experiments.run --preset overnight --env all`; six hours on two CPU cores, from
    half an hour (`lbf/spread`) to more than an hour and a half (`overcooked/diverse_orders`,
    `assistive/jaco`).
    """
    config = RunConfig(
        environment=environment,
        preset="overnight",
        seed=seed,
        partners=PartnersConfig(
            train_seeds=3,
            held_out_seeds=3,
            spare_seeds=2,
            joint=PPOConfig(total_steps=1_200_000),
            refit=best_response_config(2_000_000, num_envs=40),
            oracle=oracle_config(200_000),
            oracle_candidates=2,
        ),
        compression=CompressionConfig(fit=LONG_COMPRESSION),
        diffusion=dataclasses.replace(
            _DIFFUSION,
            fit=FitConfig(learning_rate=2e-3, steps=4000, warmup_steps=200, ema_decay=0.999),
        ),
        universal=UniversalConfig(training=universal_config(10_000_000, num_envs=240)),
        evaluation=EvaluationConfig(games=32),
    )
    return _adapted(config)


def paper(environment: str, seed: int) -> RunConfig:
    """The scale of App. C to E: five training and five held-out seeds a style.

    `python -m experiments.run --preset paper`; several hours on two CPU cores.
    """
    config = RunConfig(
        environment=environment,
        preset="paper",
        seed=seed,
        partners=PartnersConfig(joint=PPOConfig(total_steps=2_000_000), oracle_candidates=3),
        compression=CompressionConfig(
            fit=FitConfig(learning_rate=5e-3, steps=10_000, warmup_steps=200)
        ),
        diffusion=dataclasses.replace(
            _DIFFUSION,
            fit=FitConfig(learning_rate=2e-3, steps=10_000, warmup_steps=200, ema_decay=0.999),
        ),
        universal=UniversalConfig(
            seeds=3, training=universal_config(50_000_000, num_envs=336, num_minibatches=8)
        ),
        evaluation=EvaluationConfig(games=32, samples=4),
    )
    return _adapted(config)


PRESETS: dict[str, Callable[[str, int], RunConfig]] = {
    "smoke": smoke,
    "quick": quick,
    "overnight": overnight,
    "paper": paper,
}
