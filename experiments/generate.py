"""One sentence, one policy, one episode.

python -m experiments.generate "I stay on the left and never touch the onions" --gif episode.gif
python -m experiments.generate --run pretrained:overcooked/crossway "…" --gif episode.gif
python -m experiments.generate --run FOLDER "…"

The model is one that comes with the package, or a run of your own.
"""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments import devices
from experiments.errors import UserError, as_user_error, choose, main_guard
from experiments.models import DEFAULT_MODEL, open_model
from haland_jax import rollout
from haland_jax.pretrained import TrainedModel
from haland_jax.rollout import Recording


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make an agent from one sentence and play an episode with a held-out partner."""

    sentence: tyro.conf.Positional[str]
    """How the partner likes to work, in plain words, about 25 of them at most."""
    run: Annotated[str, tyro.conf.arg(metavar="FOLDER|pretrained:ENV")] = DEFAULT_MODEL
    """Folder of a finished run, or a model that comes with the package."""
    style: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Style of the partner to play with; by default the one that the sentence sounds like."""
    gif: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the episode as an animated picture."""
    seed: int = 0
    """Another seed gives another sample of the policy and another episode."""
    sampler: Literal["ddim", "ddpm"] = "ddim"
    """ddim is fast; ddpm takes all steps of Eq. 1."""


def _compile_game(model: TrainedModel, key: jax.Array) -> Callable[..., Recording]:
    """One game of key, ego, partner and style, compiled; any policies of the model's will do."""
    env, style = model.env, model.env.style_names[0]
    ego = jax.tree.map(lambda leaf: leaf[0, 0], model.oracles)
    play = jax.jit(partial(rollout.record, env), compiler_options=env.compiler_options)
    # A game is played, since a program that is compiled ahead may not hold MJX's model.
    jax.block_until_ready(play(key, ego, model.partner(style), env.style(style)))
    return play


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.generate")
    devices.prepare(cores=1)
    from experiments.gallery import save_episode

    if arguments.gif is not None and not arguments.gif.absolute().parent.is_dir():
        raise UserError(f"the folder of {arguments.gif} does not exist; make it first")
    model = open_model(arguments.run)
    env, haland = model.env, model.haland
    if arguments.style is not None:
        choose("style", arguments.style, env.style_names)
    generate_key, play_key = jax.random.split(jax.random.key(arguments.seed))
    # The compiler leaves a core idle: the game is compiled beside the generation.
    with ThreadPoolExecutor(1) as beside, as_user_error():
        compiling = beside.submit(_compile_game, model, play_key)
        made = haland.explain(arguments.sentence, generate_key, sampler=arguments.sampler)
        jax.block_until_ready(made.policy)
    play = compiling.result()
    start = time.perf_counter()
    made = haland.explain(arguments.sentence, generate_key, sampler=arguments.sampler)
    jax.block_until_ready(made.policy)
    milliseconds = 1000 * (time.perf_counter() - start)
    sounds_like = env.style_names[int(haland.nearest_style(made.v_hat))]
    style = arguments.style or sounds_like
    partner = model.partner(style)
    game = jax.tree.map(np.asarray, play(play_key, made.policy, partner, env.style(style)))

    table = Table(show_header=False, box=None)
    table.add_row("sentence", arguments.sentence)
    table.add_row("sounds like", sounds_like)
    table.add_row("policy made in", f"{milliseconds:.0f} ms (warm, {arguments.sampler})")
    table.add_row("partner", f"held-out, style {style}")
    table.add_row("return", f"{game.rewards.sum():.0f} in {game.alive.sum()} steps")
    if arguments.gif is not None:
        save_episode(env, arguments.gif, game, style, arguments.sentence)
        table.add_row("episode", str(arguments.gif))
    Console().print(table)


if __name__ == "__main__":
    main()
