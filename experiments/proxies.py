"""Human proxies: partner policies that play as the people of a study did (App. H, Fig. 7a).

    python -m experiments.proxies study --out proxies
    python -m experiments.proxies rounds.jsonl --out proxies
    python -m experiments.evaluate --run MODEL --partners proxies

The recordings are a study's folder, the URL of its database, or rounds.jsonl from its
administration page. Each round is played again to learn what the person saw; then policies are
cloned from what they did, several for each style, each from rounds drawn with replacement.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import envs
from experiments import devices
from experiments.errors import UserError, main_guard
from experiments.study.rounds import Recorded, read_rounds
from haland_jax import behaviour_cloning, checkpoint
from haland_jax.behaviour_cloning import CloningConfig, Demonstrations
from haland_jax.learner import make_networks
from haland_jax.networks import Policy


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Clone partner policies from the rounds that people played in a study."""

    recordings: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER|URL|FILE")]
    """A study's folder, its database's URL, or rounds.jsonl."""
    out: Path = Path("proxies")
    """Folder of the policies."""
    env: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Whose rounds, if the recordings are of several environments."""
    seeds: int = 3
    """Policies of each style."""
    steps: int = 2000
    """Steps of each fit."""
    seed: int = 0
    """Of the draws and the fits."""


class Proxies(NamedTuple):
    """Cloned policies.

    Attributes:
        environment: its name.
        styles: those that somebody played.
        policies: actors, leading axes [style, proxy]; styles in the order of `styles`.
        measured: by style: rounds, steps, accuracy, loss, commonest (the share of the commonest
            action, which is what an accuracy has to be held against).
    """

    environment: str
    styles: tuple[str, ...]
    policies: Policy
    measured: dict[str, dict[str, float]]


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.proxies")
    for name in ("seeds", "steps"):
        if getattr(arguments, name) < 1:
            raise UserError(f"{name} is {getattr(arguments, name)}; expected at least 1")
    devices.prepare()
    rounds = read_rounds(arguments.recordings)
    config = CloningConfig()
    fit = dataclasses.replace(
        config.fit, steps=arguments.steps, warmup_steps=min(50, arguments.steps - 1)
    )
    config = dataclasses.replace(config, fit=fit)
    proxies = make_proxies(
        rounds, arguments.env, arguments.seeds, config, jax.random.key(arguments.seed)
    )
    save(arguments.out, proxies)
    console = Console()
    console.print(table_of(proxies))
    console.print(
        f"written: {arguments.out}; to play with them: "
        f"python -m experiments.evaluate --run MODEL --partners {arguments.out}",
        soft_wrap=True,
    )


def make_proxies(
    rounds: Iterable[Recorded],
    environment: str | None,
    seeds: int,
    config: CloningConfig,
    key: jax.Array,
) -> Proxies:
    """Clones policies from rounds.

    Args:
        rounds: of one environment, or of several.
        environment: whose rounds; None if there is one only.
        seeds: policies of each style.
        config: of the cloning.
        key: consumed.

    Raises:
        UserError: which environment is meant is not clear, or a round does not earn again what
            was recorded.
    """
    rounds = list(rounds)
    by_style: dict[str, list[Recorded]] = {}
    known = sorted({one.environment for one in rounds})
    if environment is None and len(known) == 1:
        environment = known[0]
    if environment is None or environment not in known:
        raise UserError(f"there are rounds of {', '.join(known)}; name one with --env")
    for one in rounds:
        if one.environment == environment:
            by_style.setdefault(one.style, []).append(one)
    env = envs.make(environment)
    styles = tuple(name for name in env.style_names if name in by_style)
    seen = {style: _what_was_seen(env, style, by_style[style]) for style in styles}
    draw_key, fit_key = jax.random.split(key)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(draw_key)))
    demonstrations = _drawn(seen, seeds, rng)
    policies, found = behaviour_cloning.clone(
        fit_key, demonstrations, env.num_actions.partner, config
    )
    shape = (len(styles), seeds)
    policies = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), policies)
    by_name = {name: values.reshape(shape).mean(axis=1) for name, values in found.items()}
    measured = {}
    for index, style in enumerate(styles):
        actions = np.concatenate([action for _, action in seen[style]])
        measured[style] = {
            "rounds": len(seen[style]),
            "steps": len(actions),
            **{name: float(values[index]) for name, values in by_name.items()},
            "commonest": float(np.bincount(actions).max() / len(actions)),
        }
    return Proxies(environment, styles, policies, measured)


def _what_was_seen(
    env: Any, style: str, rounds: list[Recorded]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """By round: the person's observations [T, O] and actions [T]."""
    from experiments.study.arena import Arena

    ego = make_networks(env)[0].ego
    arena = Arena(env, 1, ego.init(jax.random.key(0), jnp.zeros(env.observation_sizes.ego)))
    found = []
    for one in rounds:
        again = arena.replay(env.style_names.index(style), one.game_seed, one.actions)
        if not np.array_equal(again.rewards, one.rewards):
            raise UserError(
                f"a round of {env.name}, style {style}, earns something else when it is played "
                "again; it was recorded with another version"
            )
        found.append((again.observations.partner[:-1], np.asarray(one.actions.partner)))
    return found


def _drawn(
    seen: dict[str, list[tuple[np.ndarray, np.ndarray]]], seeds: int, rng: np.random.Generator
) -> Demonstrations:
    """Demonstrations [style * seed]: all rounds of a style, as heavy as often they were drawn."""
    longest = max(sum(len(action) for _, action in rounds) for rounds in seen.values())
    rows = []
    for rounds in seen.values():
        observation, action = (np.concatenate(part) for part in zip(*rounds, strict=True))
        missing = longest - len(action)
        padded = np.pad(observation, ((0, missing), (0, 0))), np.pad(action, (0, missing))
        for _ in range(seeds):
            times = rng.multinomial(len(rounds), np.full(len(rounds), 1 / len(rounds)))
            lengths = [len(one) for _, one in rounds]
            weight = np.pad(np.repeat(times, lengths).astype(np.float32), (0, missing))
            rows.append(Demonstrations(*map(jnp.asarray, (*padded, weight))))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def save(folder: Path, proxies: Proxies) -> None:
    """Writes proxies to a folder; those of before are replaced."""
    described = {
        "environment": proxies.environment,
        "styles": list(proxies.styles),
        "measured": proxies.measured,
    }
    checkpoint.save(folder, proxies.policies, described)


def load(folder: Path) -> Proxies:
    """Proxies from a folder.

    Raises:
        UserError: there are none.
    """
    if not checkpoint.exists(folder):
        raise UserError(f"{folder} holds no proxies; make some: python -m experiments.proxies")
    described = checkpoint.read_metadata(folder)
    policies = jax.tree.map(jnp.asarray, checkpoint.restore(folder))
    styles = tuple(described["styles"])
    return Proxies(described["environment"], styles, policies, described["measured"])


def table_of(proxies: Proxies) -> Table:
    """What was cloned, for the terminal."""
    table = Table(title=f"human proxies, {proxies.environment}")
    columns = ("style", "rounds", "steps", "accuracy", "commonest action", "nats a step")
    for column in columns:
        table.add_column(column, justify="left" if column == "style" else "right")
    for style, found in proxies.measured.items():
        table.add_row(
            style.replace("_", " "),
            f"{found['rounds']:.0f}",
            f"{found['steps']:,.0f}",
            f"{found['accuracy']:.0%}",
            f"{found['commonest']:.0%}",
            f"{found['loss']:.2f}",
        )
    return table


if __name__ == "__main__":
    main()
