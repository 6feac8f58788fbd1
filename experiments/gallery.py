"""Pictures of play: an episode of a generated ego and a held-out partner for each style."""

import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import DrawnEnvironment
from experiments.progress import StageProgress
from experiments.stages import Run, load_haland, load_population
from haland_jax import rollout
from haland_jax.rollout import Recording

EPISODES = "figures/episodes"
GIF_STEPS = 200
GAMES_TO_CHOOSE_FROM = 5
SECONDS_AT_THE_END = 1.0
STRIP = 6
"""Moments of a game in its strip."""
PLAYERS = {(0,): "ego", (1,): "partner", (0, 1): "both"}


def record_episodes(run: Run, task: StageProgress) -> dict[str, Any]:
    """Writes `figures/episodes/<style>.gif` and a picture of one moment for every style.

    Of a few games the one with the median return is shown, so that the picture is typical.

    Returns:
        By style the sentence, the game's return and its `moments`, for results.json.
    """
    episodes = {}
    env = run.env
    haland, population = load_haland(run), load_population(run)
    instructions = run.instructions()
    folder = run.folder.path / EPISODES
    folder.mkdir(parents=True, exist_ok=True)
    key = jax.random.fold_in(jax.random.key(run.config.seed), 2000)
    play = jax.jit(
        lambda keys, ego, partner, style: jax.vmap(
            lambda k: rollout.record(env, k, ego, partner, style)
        )(keys),
        compiler_options=env.compiler_options,
    )
    for index, name in enumerate(env.style_names):
        generate_key, *play_keys = jax.random.split(
            jax.random.fold_in(key, index), 1 + GAMES_TO_CHOOSE_FROM
        )
        sentence = instructions[name].test[0]
        ego = haland.generate(sentence, generate_key)
        partner = _at(population.held_out_partners, (index, 0))
        games = play(jax.numpy.stack(play_keys), ego, partner, env.style(name))
        returns = np.asarray(games.rewards.sum(axis=1))
        typical = int(np.argsort(returns)[len(returns) // 2])
        game = jax.tree.map(np.asarray, _at(games, typical))
        save_episode(env, folder / f"{name}.gif", game, name, sentence, steps=GIF_STEPS)
        save_moment(env, folder / f"{name}.png", game, name, sentence, step=GIF_STEPS // 2)
        episodes[name] = {
            "sentence": sentence,
            "return": float(game.rewards.sum()),
            "moments": moments(env, game),
        }
        task.update(index + 1)
    return episodes


def moments(env: DrawnEnvironment, game: Recording) -> list[dict[str, Any]]:
    """The moments of a game that tell what both players do: each skill when it was first shown.

    Where there are more than `STRIP`, some are left out evenly; where there are fewer, others
    without a name join them.

    Args:
        env: the environment.
        game: what `rollout.record` returned, as NumPy arrays.

    Returns:
        In the order of their time: `step`, `skill` ("" for none), `score` until then, and `state`,
        the leaves of the state after it (`state_of`).
    """
    met: set[tuple[int, str]] = set()
    first: list[tuple[int, str]] = []
    for step, events in enumerate(game.events > 0):
        new: dict[str, list[int]] = {}
        for player, event in zip(*np.nonzero(events), strict=True):
            skill = env.event_names[event].split("@")[0].replace("_", " ")
            if (player, skill) not in met and not skill.startswith("stand"):
                met.add((player, skill))
                new.setdefault(skill, []).append(player)
        # What a longer name says in the same step need not be said twice.
        told = {
            skill: players
            for skill, players in new.items()
            if not any(other != skill and other.startswith(skill) for other in new)
        }
        said = [f"{PLAYERS[tuple(players)]}: {skill}" for skill, players in told.items()]
        if said:
            first.append((step, said[0] if len(said) == 1 else "\n".join(said[:2])))
    if len(first) > STRIP:
        kept = np.linspace(0, len(first) - 1, STRIP).round().astype(int)
        first = [first[place] for place in kept]
    named = [(step + 1, skill) for step, skill in first]
    last = _moments(game) - 1
    taken = {min(step, last) for step, _ in named}
    others = [step for step in np.linspace(0, last, STRIP).round().astype(int) if step not in taken]
    named += [(int(step), "") for step in others[: STRIP - len(named)]]
    scores = np.concatenate([[0.0], np.cumsum(game.rewards)])
    return [
        {
            "step": min(step, last),
            "skill": skill,
            "score": float(scores[step]),
            "state": [leaf[min(step, last)].tolist() for leaf in jax.tree.leaves(game.states)],
        }
        for step, skill in sorted(named)
    ]


def state_of(env: DrawnEnvironment, leaves: list[Any]) -> Any:
    """The state of a game from its leaves as results.json has them."""
    shapes, structure = _shapes_of_a_state(env)
    arrays = [np.asarray(leaf, shape.dtype) for leaf, shape in zip(leaves, shapes, strict=True)]
    return jax.tree.unflatten(structure, arrays)


@functools.lru_cache(maxsize=8)
def _shapes_of_a_state(env: DrawnEnvironment) -> tuple[list[jax.ShapeDtypeStruct], Any]:
    state, _ = jax.eval_shape(env.reset, jax.random.key(0), env.style(env.style_names[0]))
    return jax.tree.flatten(state)


def _at(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def save_episode(
    env: DrawnEnvironment,
    path: Path,
    game: Recording,
    style_name: str,
    caption: str,
    *,
    steps: int | None = None,
) -> float:
    """Writes a game as a GIF, up to its end.

    Args:
        env: the environment.
        path: the file.
        game: what `rollout.record` returned, as NumPy arrays.
        style_name: the partner's style.
        caption: shown under the picture, such as the sentence.
        steps: only the first steps; the whole game by default.

    Returns:
        The whole game's return.
    """
    moments = _moments(game)
    shown = slice(0, min(steps or moments, moments))
    scores = np.concatenate([[0.0], np.cumsum(game.rewards)])[:-1]
    env.viewer.save_gif(
        path,
        env,
        jax.tree.map(lambda leaf: leaf[shown], game.states),
        style=env.style(style_name),
        scores=scores[shown],
        title=style_name.replace("_", " "),
        caption=caption,
        max_steps=env.max_steps,
        hold=SECONDS_AT_THE_END,
    )
    return float(game.rewards.sum())


def _moments(game: Recording) -> int:
    """How many of a recording's states belong to the game: the end's too, if it came early."""
    return min(int(game.alive.sum()) + 1, len(game.alive))


def save_moment(
    env: DrawnEnvironment, path: Path, game: Recording, style_name: str, caption: str, *, step: int
) -> None:
    """Writes one moment of a game as a PNG and an SVG beside it; arguments as `save_episode`.

    Of a game that was over before twice as many steps its middle is shown.
    """
    step = min(step, _moments(game) // 2)
    scene = env.viewer.draw_state(
        env,
        jax.tree.map(lambda leaf: leaf[step], game.states),
        style=env.style(style_name),
        score=float(game.rewards[:step].sum()),
        title=style_name.replace("_", " "),
        caption=caption,
        max_steps=env.max_steps,
    )
    env.viewer.save_png(path, scene)
    env.viewer.save_svg(path.with_suffix(".svg"), scene)
