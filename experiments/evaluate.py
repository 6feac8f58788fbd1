"""Held-out partners, any sentences.

    python -m experiments.evaluate
    python -m experiments.evaluate --run FOLDER --instructions mine.toml --json out.json
    python -m experiments.evaluate --run FOLDER --partners proxies

The model is one that comes with the package, or a run of your own (`--run`).

FILE is TOML, style name = list of sentences:

    left_no_onion = ["I'll cook on the left, you bring the onions."]
"""

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments import devices
from experiments.errors import UserError, as_user_error, choose, main_guard
from experiments.models import DEFAULT_MODEL, instructions_of, open_model
from experiments.summary import mean, return_digits, shares
from haland_jax.pretrained import TrainedModel

LARGEST_BATCH = 64
"""Pairs that play at once; the compiled program has at most this size."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure agents made from sentences with held-out partners."""

    run: Annotated[str, tyro.conf.arg(metavar="FOLDER|pretrained:ENV")] = DEFAULT_MODEL
    """Folder of a finished run, or a model that comes with the package."""
    instructions: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """TOML file: style name = list of sentences; the packaged test sentences by default."""
    partners: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Human proxies to play with (`python -m experiments.proxies`), in place of the held-out
    partners; only styles that have some are measured."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the result as JSON too."""
    games: int = 16
    """Games of each policy and held-out partner."""
    seed: int = 0
    """Seed of generation and play."""


def read_sentences(path: Path, style_names: tuple[str, ...]) -> dict[str, list[str]]:
    """Reads a file of sentences by style.

    Raises:
        UserError: the file is missing or no TOML, names an unknown style, or holds something
            else than lists of sentences.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}); name a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f'{path} is no TOML file ({error}); write: style = ["sentence"]') from None
    if not content:
        raise UserError(f'{path} holds no sentences; write: {style_names[0]} = ["sentence"]')
    for style, sentences in content.items():
        choose("style", style, style_names)
        if isinstance(sentences, dict) and "test" in sentences:
            sentences = content[style] = sentences["test"]
        if (
            not isinstance(sentences, list)
            or not sentences
            or not all(isinstance(sentence, str) for sentence in sentences)
        ):
            raise UserError(f"{path}: {style} must be a list of at least one sentence in quotes")
    return content


def measure(
    model: TrainedModel, sentences: dict[str, list[str]], games: int, seed: int
) -> dict[str, Any]:
    """Plays one policy a sentence with every held-out partner of the sentence's style."""
    from experiments.judge import Judge, Scores

    haland, env, seeds = model.haland, model.env, model.held_out_seeds
    generate_key, play_key, oracle_key = jax.random.split(jax.random.key(seed), 3)
    rows = [(env.style_names.index(style), s) for style, found in sentences.items() for s in found]
    with as_user_error():
        v_hat, _ = haland.translate([sentence for _, sentence in rows])
    nearest = np.asarray(haland.nearest_style(v_hat))
    policies, _ = haland.generate_from_task_language(
        v_hat, jax.random.split(generate_key, len(rows))
    )
    style_rows = np.repeat([style for style, _ in rows], seeds)
    seed_rows = np.tile(np.arange(seeds), len(rows))
    judge = Judge(env, games, min(LARGEST_BATCH, len(style_rows)))

    def play(key: jax.Array, egos: Any) -> Scores:
        partner = jax.tree.map(lambda leaf: leaf[style_rows, seed_rows], model.held_out_partners)
        styles = jax.tree.map(lambda leaf: leaf[style_rows], env.styles)
        scores = judge.scores(key, egos, partner, styles)
        return scores.map(lambda values: values.reshape(len(rows), seeds))

    played = play(play_key, jax.tree.map(lambda leaf: jnp.repeat(leaf, seeds, axis=0), policies))
    best = play(oracle_key, jax.tree.map(lambda leaf: leaf[style_rows, seed_rows], model.oracles))
    returns, oracle = played.returns, best.returns
    succeeds = {"success": played.successes, "oracle_success": best.successes}
    succeeds = {name: shown for name, shown in succeeds.items() if shown is not None}
    found: dict[str, Any] = {}
    for style in sentences:
        index = env.style_names.index(style)
        mine = np.array([i for i, (of, _) in enumerate(rows) if of == index])
        share = mean(shares(returns[mine].mean(axis=0), oracle[mine].mean(axis=0)))
        found[style] = {
            "accuracy": float((nearest[mine] == index).mean()),
            "return": float(returns[mine].mean()),
            "oracle": float(oracle[mine].mean()),
            "share_of_oracle": None if np.isnan(share) else share,
            **{name: float(shown[mine].mean()) for name, shown in succeeds.items()},
            "sentences": [
                {
                    "sentence": rows[i][1],
                    "translated_to": env.style_names[nearest[i]],
                    "return": float(returns[i].mean()),
                }
                for i in mine
            ],
        }
    measured = [f["share_of_oracle"] for f in found.values() if f["share_of_oracle"] is not None]
    return {
        "environment": env.name,
        "games": games,
        "styles": found,
        "mean": {
            "accuracy": float(np.mean([f["accuracy"] for f in found.values()])),
            "return": float(np.mean([f["return"] for f in found.values()])),
            "share_of_oracle": float(np.mean(measured)) if measured else None,
            **{name: float(np.mean([f[name] for f in found.values()])) for name in succeeds},
        },
    }


def with_proxies(
    model: TrainedModel, sentences: dict[str, list[str]], folder: Path
) -> tuple[TrainedModel, dict[str, list[str]]]:
    """The model with human proxies in place of its held-out partners.

    The Oracle is then the ego that knows a trained partner of the style best, as people have none
    of their own.

    Returns:
        The model, and the sentences of those styles that have proxies.

    Raises:
        UserError: there are no proxies, those of another environment, or none of these styles.
    """
    from experiments import proxies

    found = proxies.load(folder)
    env = model.env
    if found.environment != env.name:
        raise UserError(f"{folder} has proxies of {found.environment}, the model is of {env.name}")
    spoken = {style: said for style, said in sentences.items() if style in found.styles}
    if not spoken:
        raise UserError(
            f"{folder} has proxies of {', '.join(found.styles)}; none of {', '.join(sentences)}"
        )
    rows = np.array([env.style_names.index(style) for style in found.styles])
    seeds = jax.tree.leaves(found.policies)[0].shape[1]

    def placed(leaf: jax.Array) -> jax.Array:
        empty = jnp.zeros((len(env.style_names), *leaf.shape[1:]), leaf.dtype)
        return empty.at[rows].set(leaf)

    egos = np.arange(seeds) % model.held_out_seeds
    return dataclasses.replace(
        model,
        held_out_partners=jax.tree.map(placed, found.policies),
        oracles=jax.tree.map(lambda leaf: leaf[:, egos], model.oracles),
    ), spoken


def table_of(found: dict[str, Any]) -> Table:
    """The result by style as a table for the terminal."""
    table = Table(title=f"{found['partners'].capitalize()}, {found['environment']}")
    table.add_column("style")
    succeeds = {"success": "success", "oracle_success": "Oracle's success"}
    succeeds = {name: title for name, title in succeeds.items() if name in found["mean"]}
    for column in (
        "sentences",
        "translated right",
        "return",
        "return / Oracle",
        *succeeds.values(),
    ):
        table.add_column(column, justify="right")

    digits = return_digits(values["return"] for values in found["styles"].values())

    def row(name: str, values: dict[str, Any], count: str) -> None:
        share = values["share_of_oracle"]
        shown = "–" if share is None else f"{share:.2f}"
        succeeded = [f"{values[name]:.0%}" for name in succeeds]
        earned = f"{values['return']:.{digits}f}"
        table.add_row(name, count, f"{values['accuracy']:.0%}", earned, shown, *succeeded)

    for style, values in found["styles"].items():
        row(style, values, str(len(values["sentences"])))
    table.add_section()
    row("mean", found["mean"], "")
    return table


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.evaluate")
    devices.prepare()

    if arguments.games < 1:
        raise UserError(f"games is {arguments.games}; expected at least 1")
    if arguments.json is not None and not arguments.json.absolute().parent.is_dir():
        raise UserError(f"the folder of {arguments.json} does not exist; make it first")
    model = open_model(arguments.run)
    if arguments.instructions is not None:
        sentences = read_sentences(arguments.instructions, model.env.style_names)
    else:
        sentences = {name: list(style.test) for name, style in instructions_of(model).items()}
    whom = "held-out partners"
    if arguments.partners is not None:
        model, sentences = with_proxies(model, sentences, arguments.partners)
        whom = "human proxies"
    found = {**measure(model, sentences, arguments.games, arguments.seed), "partners": whom}
    Console().print(table_of(found))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
