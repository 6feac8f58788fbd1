"""Puts other methods beside Haland: same partners, same judge, same results.json.

    python -m experiments.compare runs/lbf-spread-quick-0
    python -m experiments.compare runs/lbf-spread-quick-0 --methods cgan-mlp no-vae
    python -m experiments.compare runs/lbf-spread-quick-0 --methods --add my_method.py

Universal egos (General, Instructed and Adaptive Ego, App. C.3; self-play; fictitious co-play) learn
for as many environment steps each as all best responses of the run together; ablations (Table 1)
leave a part of Haland out. All of them are judged with the held-out partners, told the test
sentences, as Haland is. The numbers are added to the run's results.json and report.md; an
interrupted command goes on when it is called again. `--add` takes a file of your own, which defines
METHODS; docs/methods.md shows one.
"""

import dataclasses
import importlib.util
import math
import sys
import time
import zlib
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console
from rich.table import Table

from experiments import devices
from experiments.compared import NAMES, PLAYER_STAGES, STAGE, refuse_taken_names, with_compared
from experiments.errors import UserError, as_user_error, choose, main_guard
from experiments.progress import RunProgress
from experiments.run_folder import RunFolder
from experiments.summary import ORACLE, return_digits, summarise


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Put other methods beside Haland: same partners, same judge, same results."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a finished run."""
    methods: tuple[str, ...] = NAMES
    """Which methods, one after the other."""
    steps: int | None = None
    """Environment steps of each universal ego; as many as of all best responses by default."""
    seeds: int = 2
    """Egos of each kind, where a method trains egos."""
    add: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Python file with METHODS, a dictionary of methods of your own by name; all are measured."""


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.compare")
    for name in ("steps", "seeds"):
        value = getattr(arguments, name)
        if value is not None and value < 1:
            raise UserError(f"{name} is {value}; expected at least 1")
    for name in arguments.methods:
        choose("method", name, NAMES)
    if not arguments.methods and arguments.add is None:
        raise UserError(f"methods is empty; name some of {', '.join(NAMES)}, or --add a file")
    devices.prepare()
    results = measure(
        arguments.run, arguments.methods, arguments.steps, arguments.seeds, arguments.add
    )
    Console().print(table_of(results))


def measure(
    path: Path,
    names: tuple[str, ...],
    steps: int | None = None,
    seeds: int = 2,
    added: Path | None = None,
) -> dict[str, Any]:
    """Trains and judges methods; results are written after each, the report at the end.

    Args:
        path: folder of a finished run.
        names: of the methods.
        steps: of each universal ego; None for those of all best responses.
        seeds: egos of each kind.
        added: a file with further methods.

    Returns:
        The new content of the run's results.json.

    Raises:
        UserError: there is no finished run at `path`, another process writes it, a method was
            measured with other steps or seeds already, `added` defines no methods, or an ablation
            is asked of a run that came from a record or whose sentences have changed since.
    """
    from experiments import report
    from experiments.finished_run import open_run
    from experiments.judge import Judge
    from experiments.methods import ABLATIONS, METHODS, Given
    from experiments.stages import STAGE_NAMES, Run

    RunFolder.read(path, ("report",))
    config = open_run(path, PLAYER_STAGES).config
    chosen = {name: METHODS[name] for name in names} | (read_methods(added) if added else {})
    stages = {name: f"{STAGE}{name}" for name in chosen}
    with (
        RunFolder.write(path, config) as folder,
        RunProgress(stages.values(), folder) as progress,
    ):
        run = Run(config, folder)
        results = folder.read_json("results.json")
        steps = steps or int(results["universal"]["best_response_steps"])
        budgets = {
            name: {"asked_steps": steps, "seeds": seeds} if method.budgeted else {}
            for name, method in chosen.items()
        }
        # All that can be wrong with what was asked for is said before anything is trained.
        updates: dict[str, int | None] = {}
        for name, method in chosen.items():
            if name in ABLATIONS and not folder.stage_done(stages[name]):
                folder.expect_stages(STAGE_NAMES)
                run.expect_learnt_sentences()
            if folder.stage_done(stages[name]):
                _expect_same(name, stages[name], folder.stage_metrics(stages[name]), budgets[name])
            with as_user_error():
                updates[name] = method.num_updates(run, steps)
        # One for all methods, since it compiles the games.
        judge = Judge(run.env, config.evaluation.games, config.evaluation.batch)
        try:
            for name, method in chosen.items():
                stage = stages[name]
                if folder.stage_done(stage):
                    progress.skip(stage)
                    continue
                start = time.monotonic()
                with progress.stage(stage, updates[name]) as task:
                    given = Given(run, _key_of(run, stage), steps, seeds, stage, task)
                    found = _measure(judge, method, name, given)
                found = {**found, **budgets[name], "seconds": time.monotonic() - start}
                folder.finish_stage(stage, found)
                results = with_compared(results, folder)
                folder.write_json("results.json", results)
        finally:  # also of what was measured before an interruption
            report.write_report(results, path)
    return results


def read_methods(file: Path) -> dict[str, Any]:
    """The METHODS that a Python file defines.

    Raises:
        UserError: there is no such file, it defines none, or one has the name of ours.
    """
    if not file.is_file():
        raise UserError(f"{file} is missing; name a Python file that defines METHODS")
    spec = importlib.util.spec_from_file_location(f"added_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise UserError(f"{file} is no Python file; its name has to end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    methods = getattr(module, "METHODS", None)
    if not isinstance(methods, dict) or not methods:
        raise UserError(f"{file} defines no METHODS, a dictionary of methods by name")
    taken = sorted(set(methods) & set(NAMES))
    if taken:
        raise UserError(f"{file} has a method '{taken[0]}', which is one of ours; rename it")
    return methods


def _expect_same(name: str, stage: str, found: dict[str, Any], asked: dict[str, int]) -> None:
    """Checks that a finished method is the one that is asked for."""
    for what, value in asked.items():
        if found.get(what) != value:
            raise UserError(
                f"the run has '{name}' with {what.removeprefix('asked_')} = {found[what]:,} "
                f"already, not {value:,}; remove its folder '{stage}' to train it anew"
            )


def _key_of(run: Any, stage: str) -> jax.Array:
    """The method's own key, whichever methods ran before."""
    return jax.random.fold_in(jax.random.key(run.config.seed), zlib.crc32(stage.encode()) >> 1)


def _measure(judge: Any, method: Any, name: str, given: Any) -> dict[str, Any]:
    """Trains one method and plays its egos with the held-out partners."""
    from experiments.judge import by_style, over_egos
    from experiments.methods import Told
    from experiments.stages import load_population

    run = given.run
    train_key, make_key, play_key = jax.random.split(given.key, 3)
    trained = method.train(dataclasses.replace(given, key=train_key))
    refuse_taken_names(name, list(trained.egos))
    held_out = load_population(run).held_out_partners
    sentences = [list(style.test) for style in run.instructions().values()]
    methods, by_ego = {}, {}
    for place, (shown, make) in enumerate(trained.egos.items()):
        egos = []
        for style, spoken in enumerate(sentences):
            number = len(spoken) * run.config.evaluation.samples
            if method.budgeted:  # every trained ego as often as any other
                number = math.lcm(number, given.seeds)
            root = jax.random.fold_in(jax.random.fold_in(make_key, place), style)
            keys = jax.random.split(root, number)
            told = (Told(spoken[i % len(spoken)], style, i) for i in range(number))
            egos.append([make(one, key) for one, key in zip(told, keys, strict=True)])
        scores = judge.with_held_out(jax.random.fold_in(play_key, place), _stacked(egos), held_out)
        methods[shown] = by_style(over_egos(scores), run.env.style_names)
        by_ego[shown] = scores.returns.mean(axis=1)  # [style, ego]
    return {
        **trained.notes,
        "methods": methods,
        "by_ego": by_ego,
        "descriptions": trained.descriptions,
        "steps": trained.steps,
    }


def _stacked(egos: list[list[Any]]) -> Any:
    """Egos with leading axes [style, ego]."""
    rows = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *of_style) for of_style in egos]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def table_of(results: dict[str, Any]) -> Table:
    """The methods beside the Oracle for the terminal."""
    table = Table(title=f"{results['environment']}: with held-out partners")
    table.add_column("method")
    for column in ("return", "/ Oracle"):
        table.add_column(column, justify="right")
    rows = summarise(results)
    digits = return_digits(row.mean for row in rows)
    for row in rows:
        share = "" if row.method == ORACLE else f"{row.ratio:.3f}"
        table.add_row(row.method, f"{row.mean:.{digits}f}", share)
    return table


if __name__ == "__main__":
    main()
