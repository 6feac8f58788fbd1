"""Environments that need other settings than the presets'."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from haland_jax.fit import FitConfig

LONG_COMPRESSION = FitConfig(learning_rate=5e-3, steps=5000, warmup_steps=100)
"""The policy VAE's fit in recorded results."""


@dataclasses.dataclass(frozen=True)
class PresetChanges:
    """What one preset alone changes for an environment; None leaves it as it is.

    Attributes:
        joint_steps: steps of the joint training, in place of `Adaptation.length`.
        spare_seeds: spare seeds of each style, where the preset's leave no choice.
        compression: the policy VAE's fit, where the preset's is too short.
        universal_games: games in parallel of the universal egos, where those of the preset
            cannot be shared by the partners in equal parts.
        universal_start_steps: steps of the universal egos, where best responses start from them too
            and the preset does not foresee it.
        told_start: whether they start from the told one alone (`PartnersConfig.told_start`).
        trainable_layers: of BERT, where the preset's three cannot tell the styles' sentences apart.
    """

    joint_steps: int | None = None
    spare_seeds: int | None = None
    compression: FitConfig | None = None
    universal_games: int | None = None
    universal_start_steps: int | None = None
    told_start: bool | None = None
    trainable_layers: int | None = None

    def __post_init__(self) -> None:
        if self.told_start and self.universal_start_steps is None:
            raise ValueError("told_start needs universal_start_steps, which is None")


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """How the presets change for an environment.

    Attributes:
        max_steps: steps of a game.
        length: factor on the steps of the joint training.
        refit_length: factor on the steps of the best responses' refits.
        joint: settings of the joint training that differ.
        refit: settings of the best responses' refits that differ.
        partners: settings of the partners and best responses that differ.
        universal: settings of the universal egos' training that differ.
        training: settings of every training that differ; with `normalise` the policy VAE
            compresses normalised policies too.
        presets: by preset what it alone changes.
    """

    max_steps: int = 400
    length: float = 1.0
    refit_length: float = 1.0
    joint: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    refit: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    partners: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    universal: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    training: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    presets: Mapping[str, PresetChanges] = dataclasses.field(default_factory=dict)


_UNIVERSAL_START = PresetChanges(compression=LONG_COMPRESSION, universal_start_steps=40_000_000)
_TOLD_START = dataclasses.replace(_UNIVERSAL_START, told_start=True)

ADAPTATIONS = {
    # Where a style's partners learn badly, its pairs' egos have met too few conventions; an ego
    # that has met all styles knows more of them, and loses some where it is not refitted gently.
    # What a sentence says of two things at once takes more of BERT to understand.
    "overcooked/diverse_coordination": Adaptation(
        partners={"universal_rate": 1e-4},
        presets={"quick": dataclasses.replace(_TOLD_START, trainable_layers=6)},
    ),
    # Pairs that begin at the same pot keep to it, and so do refits of their egos, beside partners
    # that would serve both; an ego that has met all styles knows better. Whether it finds the
    # second pot in every style is chance, so that there are two of them to choose from. Nor does it
    # always find out in the lower corners that it pays to fill the partner's pot twice as often as
    # its own; a refit with much noise at first often does.
    "overcooked/center_pots": Adaptation(
        refit={"entropy": 0.1}, presets={"quick": _UNIVERSAL_START}
    ),
    # Both players must learn to give way.
    "overcooked/crossway": Adaptation(
        length=1.7,
        presets={"quick": _TOLD_START},
    ),
    # Pairs must learn to share the work in two rooms, and otherwise keep to the nearer pot: the
    # farther one pays some fifty steps after the first ingredient is put into it. `quick` has
    # fewer steps and is content with the nearer pot. Partners who knew one ego only stood still
    # for ever beside one that fills the second pot. Refits of their egos jam with some partners
    # that they have not met, an ego that has met all styles hardly ever does; but it would be late
    # to find out that soups made on one side may pay on the far other, which the pairs' egos know.
    "overcooked/diverse_orders": Adaptation(
        length=4.0,
        refit_length=2.0,
        joint={"entropy": 0.04, "final_entropy": 0.005},
        partners={"updates_together": 25},
        universal={
            "entropy": 0.04,
            "final_entropy": 0.005,
            "guidance": 1.0,
            "guidance_until": 0.2,
        },
        training={"discount": 0.995},
        presets={
            "quick": dataclasses.replace(
                _TOLD_START, joint_steps=1_800_000, spare_seeds=2, universal_start_steps=160_000_000
            ),
            "overnight": PresetChanges(universal_games=256),
            "paper": PresetChanges(universal_games=384),
        },
    ),
    # Learnt within 200,000 steps; the target pays 1 where a soup pays 20. Others reach nearly all
    # of it, so the last hundredth that an ego or its compression loses shows: with partners that it
    # has not met, an ego that has met all styles fails least.
    "lbf/spread": Adaptation(
        max_steps=50,
        length=0.4,
        training={"reward_scale": 2.0, "confined_until": 0.0},
        presets={"quick": _UNIVERSAL_START},
    ),
    # Speeds of joints, and observations of several units. At the mouth all pairs succeed within
    # 0.4 M steps; scratching and bathing take longest. High rates ruin egos that are good already.
    "assistive/jaco": Adaptation(
        max_steps=200,
        length=1.5,
        refit_length=0.8,
        refit={"learning_rate": 3e-4},
        # A universal ego learns little of scratching and bathing, and no style gains from it.
        # Persons who knew one robot only presented nothing to another that did as well.
        partners={"universal_start": False, "updates_together": 5},
        training={
            "normalise": True,
            "entropy": 0.001,
            "final_entropy": 0.0,
            "confined_until": 0.0,
            "partner_noise": 0.0,
            "random_start": 0.0,
            "final_random_start": 0.0,
        },
        presets={"overnight": PresetChanges(universal_games=256)},
    ),
}
"""By name in the registry."""
