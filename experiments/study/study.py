"""The study as a whole: models, database and live rounds, and what participants may do."""

import dataclasses
import secrets
from functools import partial
from typing import Any

import jax
import numpy as np

from experiments.study import store, tables
from experiments.study.agents import Agents, Made, new_seed
from experiments.study.arena import Arena
from experiments.study.live import Hall, Live
from experiments.study.pictures import Pictures, changes, tiles_of
from experiments.study.plan import plan
from experiments.study.recording import actions_of
from experiments.study.store import Begun, Store
from experiments.study.tables import BROKEN, DEMONSTRATION, END, INSTRUCTIONS, ROUNDS
from experiments.study.tasks import Tasks, tasks_of
from haland_jax import rollout
from haland_jax.pretrained import TrainedModel


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a study is.

    Attributes:
        conditions: kinds of agents that every participant meets.
        blocks: how often each.
        hertz: steps a second.
        players: how many can play at once in each environment.
        seed: of the orders and of the demonstration.
    """

    conditions: tuple[str, ...]
    blocks: int = 1
    hertz: float = 6.0
    players: int = 64
    seed: int = 0

    def __post_init__(self):
        for name, low, high in (("blocks", 1, 20), ("hertz", 0.5, 30), ("players", 1, 1024)):
            if not low <= (value := getattr(self, name)) <= high:
                raise ValueError(f"{name} is {value}; expected {low} to {high}")
        if not self.conditions:
            raise ValueError("conditions is empty; name at least one kind of agent")


class Kitchen:
    """An environment with its model, agents and live games."""

    def __init__(self, name: str, model: TrainedModel, players: int):
        """Prepares what is played in one environment; `name` is how its model was asked for."""
        self.name, self.model = name, model
        self.env = model.env
        self.agents = Agents(model)
        self.arena = Arena(model.env, players, self.agents.example)
        self.tasks: Tasks = tasks_of(model.env.name, model.env.style_names)
        scene = self.arena.draw(self.arena.first_state(), 0)
        self.tiles = tiles_of(scene)

    def compile(self) -> None:
        """Compiles what players would otherwise wait for."""
        self.agents.compile()
        self.arena.compile()


class Study:
    """A running study.

    Attributes:
        settings: what it is.
        store: its database.
        kitchens: by environment; the first one is the study's, all can be played freely.
        hall: live rounds.
        beginning: rounds that are stored and not yet in the hall.
    """

    def __init__(self, settings: Settings, store: Store):
        """A study without games; `add` the one that it is about first."""
        self.settings, self.store = settings, store
        self.kitchens: dict[str, Kitchen] = {}
        self.hall = Hall(
            settings.hertz,
            store.add_steps,
            lambda number, status, timing: store.end_round(number, status, timing=timing),
        )
        self.beginning: set[str] = set()
        self._demonstration: dict[str, Any] | None = None

    def add(self, name: str, model: TrainedModel) -> None:
        """Compiles a game, and lets people play it.

        Args:
            name: how the model was asked for.
            model: a trained model.

        Raises:
            ValueError: it cannot be played with keys, or the study's lacks a kind of agent.
        """
        kitchen = Kitchen(name, model, self.settings.players)
        if not self.kitchens:
            for condition in self.settings.conditions:
                if condition not in kitchen.agents.conditions:
                    raise ValueError(
                        f"the model {name} has no agent '{condition}', only "
                        f"{', '.join(kitchen.agents.conditions)}"
                    )
        kitchen.compile()
        if not self.kitchens:
            self._demonstration = self._demonstrate(kitchen)
        self.hall.add(kitchen.arena)
        self.kitchens[kitchen.env.name] = kitchen

    @property
    def kitchen(self) -> Kitchen:
        """The game that the study is about."""
        return next(iter(self.kitchens.values()))

    # --- Participants ----------------------------------------------------------------------------

    def enrol(self) -> tuple[tables.Participant, str]:
        """A new participant, and what their browser must hold."""
        settings = self.settings
        return self.store.enrol(
            partial(
                plan,
                conditions=settings.conditions,
                blocks=settings.blocks,
                styles=len(self.kitchen.env.style_names),
                seed=settings.seed,
            )
        )

    def go_on(self, participant: tables.Participant) -> None:
        """Takes a participant from the instructions or the demonstration to what comes next."""
        following = {INSTRUCTIONS: DEMONSTRATION, DEMONSTRATION: ROUNDS}
        if participant.stage in following:
            self.store.go_on(participant.id, following[participant.stage])

    def end(self, participant: tables.Participant) -> None:
        """Takes a participant who has played all rounds to the last page."""
        self.store.go_on(participant.id, END)

    def make(self, participant: tables.Participant, sentence: str) -> tuple[Made, Begun]:
        """Makes the agent of the participant's next round; slow, so not on the server's thread.

        Raises:
            ValueError: the sentence is blank or too long.
        """
        found = store.next_round(participant)
        assert found is not None
        number, planned = found
        kitchen = self.kitchen
        made = kitchen.agents.make(planned.condition, sentence, new_seed())
        return made, Begun(
            number=number,
            condition=planned.condition,
            environment=kitchen.env.name,
            model=kitchen.name,
            fingerprint=kitchen.agents.fingerprint,
            style=kitchen.env.style_names[planned.style],
            sentence=sentence.strip(),
            sounds_like=made.sounds_like,
            agent_seed=made.seed,
            game_seed=new_seed(),
            policy=kitchen.agents.pack(made.policy),
            hertz=self.settings.hertz,
        )

    async def begin(self, participant: tables.Participant, made: Made, begun: Begun) -> Live:
        """Begins a round whose agent has been made.

        Raises:
            Full: all seats are taken.
            sqlalchemy.exc.IntegrityError: it was begun already.
        """
        number = await self.hall.in_writer(lambda: self.store.begin_round(participant.id, begun))
        style = self.kitchen.env.style_names.index(begun.style)
        self.beginning.add(key_of(number))
        try:
            return await self.hall.begin(
                key_of(number), begun.environment, made.policy, style, begun.game_seed, number
            )
        except BaseException:
            await self.hall.in_writer(lambda: self.store.end_round(number, BROKEN))
            raise
        finally:
            self.beginning.discard(key_of(number))

    def has(self, one: tables.Round) -> bool:
        """Whether a round is being played, or about to be."""
        return key_of(one.id) in self.hall.rounds or key_of(one.id) in self.beginning

    async def begin_free(self, environment: str, style: int, made: Made) -> str:
        """Begins a game that is not recorded; returns what it is found by."""
        key = secrets.token_urlsafe(16)
        await self.hall.begin(key, environment, made.policy, style, new_seed())
        return key

    # --- After a crash ---------------------------------------------------------------------------

    async def resume(self) -> dict[str, int]:
        """Goes on with the rounds that were being played; those that cannot are marked broken.

        Returns:
            How many of each.
        """
        found = {"resumed": 0, BROKEN: 0}
        for one in self.store.rounds(tables.PLAYING):
            try:
                kitchen = self.kitchens[one.environment]
                if one.fingerprint != kitchen.agents.fingerprint:
                    raise ValueError("it was begun with another model")
                whole = self.store.round(one.id)
                policy = kitchen.agents.unpack(whole.policy)
                played = self.store.steps(one.id)
                style = kitchen.env.style_names.index(one.style)
                await self.hall.begin(
                    key_of(one.id), one.environment, policy, style, one.game_seed, one.id, played
                )
                found["resumed"] += 1
            except (KeyError, ValueError, RuntimeError):
                self.store.end_round(one.id, BROKEN)
                found[BROKEN] += 1
        return found

    # --- Looking again ---------------------------------------------------------------------------

    @property
    def demonstration(self) -> dict[str, Any]:
        """A game of an agent and a trained partner, for the page."""
        assert self._demonstration is not None, "add a game first"
        return self._demonstration

    def replay(self, one: tables.Round) -> dict[str, Any]:
        """A round again, for the page.

        Raises:
            ValueError: its recording is damaged, or the engine now plays it otherwise.
        """
        kitchen = self.kitchens[one.environment]
        steps = self.store.steps(one.id)
        style = kitchen.env.style_names.index(one.style)
        again = kitchen.arena.replay(style, one.game_seed, actions_of(steps))
        if not np.array_equal(again.rewards, steps["reward"]):
            raise ValueError(f"round {one.id} earns something else when it is played again")
        return film(kitchen.arena, again.states, style, again.rewards, one.hertz)

    def _demonstrate(self, kitchen: Kitchen) -> dict[str, Any]:
        """The first style's first trained partner, with the agent that knows it best."""
        style = 0
        env, model = kitchen.env, kitchen.model
        ego, partner = (
            jax.tree.map(lambda leaf: leaf[style, 0], policies)
            for policies in (model.oracles, model.held_out_partners)
        )
        play = jax.jit(partial(rollout.record, env), compiler_options=env.compiler_options)
        game = play(jax.random.key(self.settings.seed), ego, partner, env.style(env.style_names[0]))
        game = jax.tree.map(np.asarray, game)
        length = int(game.alive.sum())
        states = jax.tree.map(lambda leaf: leaf[:length], game.states)
        rewards = game.rewards[: length - 1]
        return film(kitchen.arena, states, style, rewards, self.settings.hertz)


def key_of(number: int) -> str:
    """How the hall finds a recorded round."""
    return f"round {number}"


def film(
    arena: Arena, states: Any, style: int, rewards: np.ndarray, hertz: float
) -> dict[str, Any]:
    """States [T + 1] and rewards [T] of a game as the page plays them."""
    pictures, before, frames = Pictures(), None, []
    score = 0.0
    for step in range(len(rewards) + 1):
        state = jax.tree.map(lambda leaf, s=step: leaf[s], states)
        board = pictures.board(arena.draw(state, style))
        score += float(rewards[step - 1]) if step else 0.0
        frames.append({"step": step, "score": round(score, 3), "tiles": changes(before, board)})
        before = board
    used = {picture for frame in frames for _, picture in frame["tiles"]}
    return {
        "hertz": hertz,
        "frames": frames,
        "pictures": {number: pictures[number] for number in sorted(used)},
    }
