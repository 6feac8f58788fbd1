"""What a method is: the one protocol that baselines, ablations and your own methods share.

A method is given the training partners of a finished run and what the run made of them. It trains
whatever it wants and returns, by name, how it makes an ego: from what it is told about a partner, a
policy or an `Agent` (which may remember, and sees what the partner did last). It must not use the
held-out partners, with which `python -m experiments.compare` judges it.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax

from experiments.progress import StageProgress
from experiments.stages import Run, load_archive, load_population
from experiments.training import Saver
from haland_jax import checkpoint, mirrors
from haland_jax.networks import Policy
from haland_jax.partners import Player
from haland_jax.ppo_loss import PPOConfig
from haland_jax.rollout import Agent

EGOS = "egos"
"""The folder of a method's trained egos."""


class Told(NamedTuple):
    """What a method is told of a partner that it is to play with.

    Attributes:
        sentence: what the partner says of itself; none of the training sentences.
        style: number of its style.
        number: how many egos were asked for before for this style; a method that trained several
            egos gives them in turn.
    """

    sentence: str
    style: int
    number: int


MakeEgo = Callable[[Told, jax.Array], Policy | Agent]
"""Makes an ego from what it is told and a key, which it consumes."""


class Trained(NamedTuple):
    """What a method has learnt.

    Attributes:
        egos: how it makes an ego, by the name that tables and figures show.
        descriptions: what each of them is, in a few words.
        steps: environment steps that each of them took.
        notes: anything else to be kept in results.json, such as learning curves.
    """

    egos: Mapping[str, MakeEgo]
    descriptions: Mapping[str, str]
    steps: int = 0
    notes: Mapping[str, Any] = {}


@dataclasses.dataclass(frozen=True)
class Given:
    """What a method may learn from.

    Attributes:
        run: the finished run, for those that use more of it, such as its policy VAE; its held-out
            partners, their Oracles and the test sentences are for the judge alone.
        key: of all randomness.
        steps: environment steps that an ego may take; by default as many as all best responses of
            the run took together.
        seeds: how many egos of each kind to train.
        stage: folder of the run that belongs to the method.
        task: the progress; call `task.update(done, metrics)` now and then.
    """

    run: Run
    key: jax.Array
    steps: int
    seeds: int
    stage: str
    task: StageProgress

    @property
    def env(self) -> Any:
        """The environment."""
        return self.run.env

    @property
    def partners(self) -> Policy:
        """Actors of all partners that the run's egos learn with, leading axes [style, partner]."""
        return mirrors.teachers(self.env, self.run.config.partners, load_population(self.run))

    @property
    def best_responses(self) -> Player:
        """The run's best responses to the partners of each style, leading axes [style, seed].

        In a run that was made of a record only their actors are known; the rest is NaN.
        """
        return load_archive(self.run).egos

    @property
    def sentences(self) -> list[list[str]]:
        """The training sentences of each style."""
        return [list(style.train) for style in self.run.instructions().values()]

    def path(self, name: str) -> Path:
        """Where the method may keep something."""
        return self.run.path(self.stage, name)

    def keep(self, egos: Any) -> None:
        """Keeps parameters of trained egos in the method's folder, for whoever plays them later."""
        checkpoint.save(self.path(EGOS), egos)

    def saver(self, name: str) -> Saver:
        """Keeps the state of a long training, so that an interrupted one goes on."""
        return Saver(self.path(f"unfinished_{name}"))

    def saver_of(self, training: PPOConfig) -> Saver:
        """As `saver`, for egos that learn in games; other lengths or numbers start anew."""
        return self.saver(f"{training.num_updates}_updates_{self.seeds}_seeds")


class Method(Protocol):
    """A way to make egos for partners that are told of.

    Attributes:
        budgeted: whether it trains `Given.seeds` egos for `Given.steps` steps each.
    """

    budgeted: bool

    def num_updates(self, run: Run, steps: int) -> int | None:
        """How many updates `train` will report; None if that is not known.

        Raises:
            ValueError: `steps` are too few.
        """
        ...

    def train(self, given: Given) -> Trained:
        """Learns with the training partners."""
        ...
