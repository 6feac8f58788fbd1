"""What a bundle keeps of its run: sizes, losses, and the card that tells them."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from experiments.evaluate import measure
from experiments.models import instructions_of
from haland_jax import policy_vae, rollout
from haland_jax.pretrained import TrainedModel

STATES = 256
MEGABYTE = 1_000_000


def mean_returns(results: Mapping[str, Any]) -> dict[str, float]:
    """Mean return of each method over styles and held-out seeds, from results.json."""
    return {
        method: float(np.mean([style["returns"] for style in styles.values()]))
        for method, styles in results["methods"].items()
    }


def measure_losses(before: TrainedModel, after: TrainedModel, games: int) -> dict[str, Any]:
    """Compares a run's model with its bundle, on the packaged test sentences.

    Args:
        before: the run's model.
        after: the same, stored and read back.
        games: games of each generated policy and held-out partner.

    Returns:
        `translation`: largest difference of the task language, which lies in [0, 1];
        `decisions`: sentences whose nearest style differs, of `sentences`;
        `divergence`: mean and largest KL in nats, over the policies, from those that the run
        generates to those that the bundle generates from the same sentence and noise, in
        states of their games; and for both models the `accuracy` of the translation, the mean
        `return` and the `share` of the Oracle's, with the same randomness.
    """
    spoken = {name: list(style.test) for name, style in instructions_of(before).items()}
    sentences = [sentence for found in spoken.values() for sentence in found]
    styles = np.repeat(np.arange(len(spoken)), [len(found) for found in spoken.values()])
    language, language_after = (m.haland.translate(sentences)[0] for m in (before, after))
    differs = before.haland.nearest_style(language) != after.haland.nearest_style(language_after)
    divergence = _divergence(before, after, language, language_after, styles)
    measured = [measure(model, spoken, games, seed=0)["mean"] for model in (before, after)]
    return {
        "sentences": len(sentences),
        "translation": float(jnp.abs(language - language_after).max()),
        "decisions": int(differs.sum()),
        "divergence": {"mean": float(divergence.mean()), "largest": float(divergence.max())},
        "games": games,
        "accuracy": [found["accuracy"] for found in measured],
        "return": [found["return"] for found in measured],
        "share": [found["share_of_oracle"] for found in measured],
    }


def _divergence(
    before: TrainedModel,
    after: TrainedModel,
    language: jax.Array,
    language_after: jax.Array,
    styles: np.ndarray,
) -> jax.Array:
    """KL of each pair of generated policies, mean over states of the first one's games."""
    count = len(styles)
    generate_key, play_key = jax.random.split(jax.random.key(1))
    noise = jax.random.split(generate_key, count)
    first, _ = before.haland.generate_from_task_language(language, noise)
    second, _ = after.haland.generate_from_task_language(language_after, noise)
    env = before.env
    held_out = jax.tree.map(lambda leaf: leaf[styles, :1], before.held_out_partners)
    visit = jax.jit(
        jax.vmap(
            lambda key, ego, partner, style: rollout.visited_observations(
                env, key, ego, partner, style, num_kept=STATES
            )
        ),
        compiler_options=env.compiler_options,
    )
    with_styles = jax.tree.map(lambda leaf: leaf[styles], env.styles)
    states = visit(jax.random.split(play_key, count), first, held_out, with_styles)
    return jax.jit(policy_vae.policy_kl)(first, second, states)


def _size_rows(sizes: Mapping[str, int]) -> list[tuple[str, str]]:
    rows = [
        (name.replace("_", " "), f"{size / MEGABYTE:.2f} MB")
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])
    ]
    return [*rows, ("all", f"{sum(sizes.values()) / MEGABYTE:.2f} MB")]


def _loss_rows(losses: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """What is compared, the run's value, and the bundle's (or the difference)."""

    def percent(value: float | None) -> str:
        return "–" if value is None else f"{value:.1%}"

    divergence = losses["divergence"]
    return [
        ("task language, largest difference (0 to 1)", "", f"{losses['translation']:.4f}"),
        ("sentences with another style", "", f"{losses['decisions']} of {losses['sentences']}"),
        (
            "KL of generated policies, mean (largest)",
            "",
            f"{divergence['mean']:.5f} ({divergence['largest']:.5f}) nats",
        ),
        ("test sentences translated right", *map(percent, losses["accuracy"])),
        ("mean return with held-out partners", *(f"{value:.1f}" for value in losses["return"])),
        ("return / Oracle", *map(percent, losses["share"])),
    ]


def table_of(environment: str, sizes: Mapping[str, int], losses: Mapping[str, Any]) -> Table:
    """Sizes and losses for the terminal."""
    table = Table(title=f"Bundle of {environment}")
    table.add_column("part")
    table.add_column("run", justify="right")
    table.add_column("bundle", justify="right")
    for name, size in _size_rows(sizes):
        table.add_row(name, "", size)
    table.add_section()
    for row in _loss_rows(losses):
        table.add_row(*row)
    return table


def card(
    environment: str,
    about: Mapping[str, Any],
    sizes: Mapping[str, int],
    losses: Mapping[str, Any],
) -> str:
    """The bundle's card.md."""
    run, encoder = about["run"], about["encoder"] or "the packaged all-MiniLM-L6-v2"
    lines = [
        f"# A trained model of {environment}",
        "",
        f"Exported on {about['exported']} from a run with preset `{run['preset']}`, seed "
        f"{run['seed']}: {run['partners']['held_out_seeds']} held-out partners of each style, with "
        "their Oracles, come along to play with. The translator was fine-tuned from "
        f"{encoder}.",
        "",
        "```bash",
        f'python -m experiments.generate --run pretrained:{environment} "I …" --gif episode.gif',
        f"python -m experiments.evaluate --run pretrained:{environment}",
        "```",
        "",
        "## Size",
        "",
        "Large arrays are stored in 8 bits with a step for each column, others in half precision; "
        "of the encoder only the difference that fine-tuning made, for which 8 bits are as fine "
        "as half precision of the parameters themselves.",
        "",
        "| part | size |",
        "| --- | ---: |",
        *(f"| {name} | {size} |" for name, size in _size_rows(sizes)),
        "",
        "## What was lost",
        "",
        f"The run in float32 beside this bundle, on {losses['sentences']} packaged test sentences, "
        f"{losses['games']} games of each policy and held-out partner, with the same randomness:",
        "",
        "| | run | bundle |",
        "| --- | ---: | ---: |",
        *(f"| {name} | {before} | {after} |" for name, before, after in _loss_rows(losses)),
    ]
    if "results" in about:
        lines += [
            "",
            "## The run's results",
            "",
            "| method | mean return with held-out partners |",
            "| --- | ---: |",
            *(f"| {method} | {value:.1f} |" for method, value in about["results"].items()),
        ]
    return "\n".join(lines) + "\n"
