"""Environments that need other settings than the presets'."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from haland_jax.fit import FitConfig


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
        spare_seeds: spare seeds of each style by preset, where the preset's leave no choice.
        joint_steps: steps of the joint training by preset, in place of `length`.
        compression: the policy VAE's fit by preset, where the preset's is too short.
        universal_games: games in parallel of the universal egos by preset, where those of the
            preset cannot be shared by the partners in equal parts.
        universal_start: steps of the universal egos by preset, where best responses start from
            them too and the preset does not foresee it.
        told_start: whether they are `PartnersConfig.told_start` there.
        universal: settings of the universal egos' training that differ.
        training: settings of every training that differ; with `normalise` the policy VAE
            compresses normalised policies too.
    """

    max_steps: int = 400
    length: float = 1.0
    refit_length: float = 1.0
    joint: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    refit: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    partners: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    spare_seeds: Mapping[str, int] = dataclasses.field(default_factory=dict)
    joint_steps: Mapping[str, int] = dataclasses.field(default_factory=dict)
    compression: Mapping[str, FitConfig] = dataclasses.field(default_factory=dict)
    universal_games: Mapping[str, int] = dataclasses.field(default_factory=dict)
    universal_start: Mapping[str, int] = dataclasses.field(default_factory=dict)
    told_start: bool = False
    universal: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    training: Mapping[str, Any] = dataclasses.field(default_factory=dict)


LONG_COMPRESSION = FitConfig(learning_rate=5e-3, steps=5000, warmup_steps=100)
"""The policy VAE's fit in recorded results."""

ADAPTATIONS = {
    # Pairs that begin at the same pot keep to it, and so do refits of their egos, beside partners
    # that would serve both; an ego that has met all styles knows better.
    "overcooked/center_pots": Adaptation(
        compression={"quick": LONG_COMPRESSION},
        universal_start={"quick": 40_000_000},
        told_start=True,
    ),
    # Both players must learn to give way.
    "overcooked/crossway": Adaptation(
        length=1.7,
        compression={"quick": LONG_COMPRESSION},
        universal_start={"quick": 40_000_000},
        told_start=True,
    ),
    # Pairs must learn to share the work in two rooms, and otherwise keep to the nearer pot: the
    # farther one pays some fifty steps after the first ingredient is put into it. `quick` has
    # fewer steps and is content with the nearer pot. Partners who knew one ego only stood still
    # for ever beside one that fills the second pot. Refits of their egos jam with some partners
    # that they have not met, an ego that has met all styles hardly ever does; but it would be late
    # to find out that soups made on one side may pay on the far other, which the pairs' egos know.
    "overcooked/diverse_orders": Adaptation(
        length=4.0,
        joint_steps={"quick": 1_800_000},
        refit_length=2.0,
        joint={"entropy": 0.04, "final_entropy": 0.005},
        partners={"updates_together": 25},
        spare_seeds={"quick": 2},
        compression={"quick": LONG_COMPRESSION},
        universal_games={"overnight": 256, "paper": 384},
        universal_start={"quick": 160_000_000},
        told_start=True,
        universal={
            "entropy": 0.04,
            "final_entropy": 0.005,
            "guidance": 1.0,
            "guidance_until": 0.2,
        },
        training={"discount": 0.995},
    ),
    # Learnt within 200,000 steps; the target pays 1 where a soup pays 20. Others reach nearly all
    # of it, so the last hundredth that an ego or its compression loses shows: with partners that it
    # has not met, an ego that has met all styles fails least.
    "lbf/spread": Adaptation(
        max_steps=50,
        length=0.4,
        compression={"quick": LONG_COMPRESSION},
        universal_start={"quick": 40_000_000},
        training={"reward_scale": 2.0, "confined_until": 0.0},
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
        universal_games={"overnight": 256},
        training={
            "normalise": True,
            "entropy": 0.001,
            "final_entropy": 0.0,
            "confined_until": 0.0,
            "partner_noise": 0.0,
            "random_start": 0.0,
            "final_random_start": 0.0,
        },
    ),
}
"""By name in the registry."""
