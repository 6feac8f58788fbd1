"""How fast the environments and their training are on this machine.

    python -m experiments.benchmark env                   Overcooked against JaxMARL's
    python -m experiments.benchmark env --json out.json
    python -m experiments.benchmark lbf                   level-based foraging against Jumanji's
    python -m experiments.benchmark arm                   the assistive arm beside C MuJoCo
    python -m experiments.benchmark ppo                   training pairs of players
    python -m experiments.benchmark ppo --learner recurrent    training egos with a memory
    python -m experiments.benchmark brax RUN              training one player, beside Brax's PPO
    python -m experiments.benchmark study                 the web study with fifty players

Absolute figures drift with the machine's load; ratios of one run hold.
"""

import dataclasses
import functools
import importlib.metadata
import importlib.util
import json
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

import jax
import tyro
from rich.console import Console
from rich.table import Table

import envs
from experiments import (
    benchmark_arm,
    benchmark_lbf,
    benchmark_ppo,
    contenders,
    contenders_lbf,
    devices,
    models,
)
from experiments.configs import DEFAULT_ENVIRONMENT
from experiments.contenders import PEER, PEER_PLAIN
from experiments.errors import UserError, as_user_error, choose, main_guard
from experiments.machine import describe_machine

KITCHENS = ("cramped_room", "counter_circuit")
BARS = {"features": 5.0, "grid": 2.0}
"""Times the speed of JaxMARL that each of our observations is expected to reach."""
DESCRIPTION = "Measure how fast the environments and their training are on this machine."
INSTALL_PEER = f"{PEER} is not installed; compare with it after: uv sync --group peers"


@dataclasses.dataclass(frozen=True)
class _ContestArguments:
    """What both contests of engines have in common."""

    batch: int = 512
    """Games played at once."""
    repeats: int = 5
    """Repeats of each; the fastest counts."""
    cores: int = 2
    """Cores to use."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the result as JSON too."""


@dataclasses.dataclass(frozen=True)
class EnvArguments(_ContestArguments):
    """Measure Overcooked with random actions, both players observed at every step.

    Ours with the feature vector and with the grid, and JaxMARL's (where it is installed) take
    turns in one process. Ours shares the games out over one device a core; JaxMARL gets the
    better of one program on all cores and the same sharing out. "JaxMARL, our restart" leaves
    out its reset at every step, as our loop does; the bars are set against JaxMARL as it is.
    """

    kitchens: tuple[str, ...] = KITCHENS
    """Classic kitchens to measure."""
    steps: int = 1000
    """Steps of each game in one repeat; games last 400 steps and start again."""


@dataclasses.dataclass(frozen=True)
class LbfArguments(_ContestArguments):
    """Measure level-based foraging on random fields of 15 x 15 cells, two players, eight foods.

    Ours with each observation and Jumanji's with the same kind (where it is installed) take
    turns in one process, the games shared out over one device a core; both start again on a
    new field. "our restart" leaves out Jumanji's reset at every step, as our loop does; the
    bars are set against Jumanji as it is.
    """

    encodings: tuple[str, ...] = tuple(contenders_lbf.ENCODINGS)
    """Our observations to measure."""
    steps: int = 300
    """Steps of each game in one repeat; games last 100 steps and start again."""


@dataclasses.dataclass(frozen=True)
class ArmArguments(_ContestArguments):
    """Measure the assistive arm with random actions: MJX, and the same model in C MuJoCo.

    Ours shares the games out over one device a core; C MuJoCo plays on as many threads. Its
    physics has neither observations nor rewards, so it is set beside our physics alone too.
    """

    steps: int = 50
    """Steps of each game in one repeat, 0.1 s each."""


@dataclasses.dataclass(frozen=True)
class PpoArguments:
    """Measure PPO: pairs of players that both learn, or universal egos with a memory.

    Pairs have all styles and four seeds in one program and the settings of the preset `quick`,
    the three kinds of universal egos those of `overnight`. The time to compile is told apart.
    """

    env: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_ENVIRONMENT
    """Environment with partner styles."""
    learner: Literal["pairs", "recurrent"] = "pairs"
    """Who learns: pairs, or General, Instructed and Adaptive Ego (LSTM)."""
    updates: int = 4
    """Updates of every learner in one repeat (a pair's has 1600 steps)."""
    repeats: int = 3
    """Repeats; the fastest counts."""
    cores: int | None = None
    """Cores to use; all by default."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the result as JSON too."""


@dataclasses.dataclass(frozen=True)
class BraxArguments:
    """Measure our PPO beside Brax's on the assistive arm: an ego for a frozen partner.

    Both have the same world, steps, networks and settings; Brax's is tried with two learning
    rates. Times are without compilation.
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Whose partner: a finished run's folder, or `pretrained:` and an environment."""
    style: Annotated[str, tyro.conf.arg(metavar="NAME")] = "scratch_upper_arm"
    """The partner's style."""
    steps: int = 1_000_000
    """Steps of each ego."""
    seeds: int = 2
    """Egos of each learner."""
    games: int = 64
    """Games in which each ego is judged."""
    cores: int | None = None
    """Cores to use; all by default."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the result as JSON too."""


@dataclasses.dataclass(frozen=True)
class StudyArguments:
    """Measure the web study with many players at once, each in a round of their own.

    A server of its own, 6 steps a second; players press buttons at random over real connections
    from this process, on the same cores.
    """

    players: int = 50
    """Players at once."""
    seconds: float = 30.0
    """How long they play; a round ends after 67 seconds."""
    cores: int = 1
    """Devices of this process, which computes nothing."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the result as JSON too."""


Arguments = (
    Annotated[EnvArguments, tyro.conf.subcommand("env")]
    | Annotated[LbfArguments, tyro.conf.subcommand("lbf")]
    | Annotated[ArmArguments, tyro.conf.subcommand("arm")]
    | Annotated[PpoArguments, tyro.conf.subcommand("ppo")]
    | Annotated[BraxArguments, tyro.conf.subcommand("brax")]
    | Annotated[StudyArguments, tyro.conf.subcommand("study")]
)


def measure_kitchen(kitchen: str, batch: int, steps: int, repeats: int) -> dict[str, Any]:
    """Steps per second of every contender in one kitchen.

    Returns:
        By contender: `steps_per_second`; for ours beside the peer also `ratio`, `bar`, `met`
        and `ratio_to_our_restart`; for the peer the `configuration` that was the faster one.
    """
    peers = (PEER, PEER_PLAIN) if contenders.has_peer() else ()
    entries = [(f"ours, {e}", contenders.our_games(kitchen, e), True) for e in BARS]
    for name in peers:
        contender = contenders.peer_games(kitchen, own_reset=name == PEER)
        entries += [
            (f"{name}: one program", contender, False),
            (f"{name}: shared out", contender, True),
        ]
    programs = {
        name: contenders.compile_games(contender, batch, steps, shared_out=shared_out)
        for name, contender, shared_out in entries
    }
    seconds = contenders.fastest(programs, repeats)
    speeds = {name: batch * steps / taken for name, taken in seconds.items()}
    found: dict[str, Any] = {}
    for name in peers:
        best = max((n for n in speeds if n.startswith(f"{name}: ")), key=lambda n: speeds[n])
        found[name] = {
            "steps_per_second": speeds[best],
            "configuration": best.removeprefix(f"{name}: "),
        }
    for encoding, bar in BARS.items():
        speed = speeds[f"ours, {encoding}"]
        row = found[f"ours, {encoding}"] = {"steps_per_second": speed}
        if peers:
            ratio = speed / found[PEER]["steps_per_second"]
            plain = speed / found[PEER_PLAIN]["steps_per_second"]
            row |= {"ratio": ratio, "bar": bar, "met": ratio >= bar, "ratio_to_our_restart": plain}
    return found


def machine() -> dict[str, Any]:
    """What the figures were measured on, peers included."""
    described = describe_machine()
    peers = (("jaxmarl", contenders), ("jumanji", contenders_lbf))
    packages = ("jaxlib", *(name for name, module in peers if module.has_peer()))
    return {
        **described,
        "devices": f"{len(jax.devices())} x {jax.devices()[0].device_kind}",
        **{name: importlib.metadata.version(name) for name in packages},
    }


def _judged(met: bool) -> str:
    return "[green]met[/]" if met else "[red]missed[/]"


def env_table(found: dict[str, Any]) -> Table:
    """The environment's speeds for the terminal."""
    table = Table(
        title=f"Overcooked, random actions, {found['batch']} games at once",
        caption=", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    )
    for column in ("kitchen", "engine"):
        table.add_column(column)
    for column in ("steps/s", f"x {PEER}", "bar", "", "x our restart"):
        table.add_column(column, justify="right")
    for kitchen, rows in found["kitchens"].items():
        for name, row in rows.items():
            note = f" ({row['configuration']})" if "configuration" in row else ""
            judged = ()
            if "ratio" in row:
                judged = (
                    f"{row['ratio']:.1f}",
                    f">= {row['bar']:.0f}",
                    _judged(row["met"]),
                    f"{row['ratio_to_our_restart']:.1f}",
                )
            table.add_row(kitchen, name + note, f"{row['steps_per_second']:,.0f}", *judged)
        table.add_section()
    return table


def _prepare(cores: int | None) -> None:
    """Holds the process, and so every contender, to some cores; compiles anew."""
    if cores is not None and hasattr(os, "sched_setaffinity"):
        usable = sorted(os.sched_getaffinity(0))
        if len(usable) < cores:
            raise UserError(f"cores is {cores}; expected at most {len(usable)} on this machine")
        os.sched_setaffinity(0, usable[:cores])
    devices.prepare(cores=cores)
    jax.config.update("jax_enable_compilation_cache", False)


def _check(arguments: Arguments) -> None:
    for field in dataclasses.fields(arguments):
        value = getattr(arguments, field.name)
        if isinstance(value, int) and value < 1:
            raise UserError(f"{field.name} is {value}; expected at least 1")
    if arguments.json is not None and not arguments.json.absolute().parent.is_dir():
        raise UserError(f"the folder of {arguments.json} does not exist; make it first")
    if isinstance(arguments, PpoArguments):
        choose("environment", arguments.env, envs.names(styled_only=True))
        return
    if isinstance(arguments, BraxArguments | StudyArguments):
        return
    if isinstance(arguments, LbfArguments):
        for encoding in arguments.encodings:
            choose("encoding", encoding, tuple(contenders_lbf.ENCODINGS))
    elif isinstance(arguments, EnvArguments):
        for kitchen in arguments.kitchens:
            choose("kitchen", kitchen, KITCHENS)
    if arguments.batch % arguments.cores:
        raise UserError(
            f"batch is {arguments.batch}; expected a multiple of cores = {arguments.cores}"
        )


def _compile_without_fusion() -> None:
    """Makes XLA compile all programs in the way that MJX needs on a CPU.

    Brax compiles by itself and takes no options. Call it before the first computation.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false".strip()


def _compare_learners(
    arguments: BraxArguments, contest: ModuleType, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Our PPO and Brax's for one of a model's partners."""
    model = models.open_model(arguments.model)
    if not model.env.continuous:
        raise UserError(f"{model.env.name} has discrete actions; Brax needs continuous ones")
    with as_user_error():
        config = contest.learner_config(model.env.name, arguments.steps)
    style = choose("style", arguments.style, model.env.style_names)
    sizes = (arguments.seeds, arguments.games)
    learners = contest.measure_learners(model, style, config, *sizes, tell=tell)
    return {
        "environment": model.env.name,
        "style": style,
        "steps": config.total_steps,
        "seeds": arguments.seeds,
        "games": arguments.games,
        "learners": learners,
        "machine": machine(),
    }


@main_guard
def main() -> None:
    """The command."""
    arguments = tyro.cli(Arguments, prog="python -m experiments.benchmark", description=DESCRIPTION)
    _check(arguments)
    if isinstance(arguments, BraxArguments):
        _compile_without_fusion()
    _prepare(arguments.cores)
    console = Console()
    if isinstance(arguments, PpoArguments):
        measures = {
            "pairs": benchmark_ppo.measure_ppo,
            "recurrent": benchmark_ppo.measure_recurrent,
        }
        measure = measures[arguments.learner]
        found = measure(arguments.env, arguments.updates, arguments.repeats)
        found["machine"] = machine()
        console.print(benchmark_ppo.ppo_table(found))
    elif isinstance(arguments, BraxArguments):
        # Brax takes seconds to import, for which the other contests need not wait.
        from experiments import benchmark_brax

        found = _compare_learners(arguments, benchmark_brax, console.print)
        console.print(benchmark_brax.brax_table(found))
    elif isinstance(arguments, StudyArguments):
        # The server's libraries, too.
        from experiments import benchmark_study

        found = benchmark_study.measure_study(arguments.players, arguments.seconds)
        found["machine"] = machine()
        console.print(benchmark_study.study_table(found))
    elif isinstance(arguments, LbfArguments):
        batch, steps = arguments.batch, arguments.steps
        engines = benchmark_lbf.measure_fields(arguments.encodings, batch, steps, arguments.repeats)
        found = {"batch": batch, "steps": steps, "engines": engines, "machine": machine()}
        console.print(benchmark_lbf.lbf_table(found))
        if not contenders_lbf.has_peer():
            console.print(benchmark_lbf.INSTALL_PEER, highlight=False)
    elif isinstance(arguments, ArmArguments):
        batch, steps = arguments.batch, arguments.steps
        engines = benchmark_arm.measure_arm(batch, steps, arguments.repeats, arguments.cores)
        found = {"batch": batch, "steps": steps, "engines": engines, "machine": machine()}
        console.print(benchmark_arm.arm_table(found))
    else:
        measure = functools.partial(
            measure_kitchen,
            batch=arguments.batch,
            steps=arguments.steps,
            repeats=arguments.repeats,
        )
        found = {
            "batch": arguments.batch,
            "steps": arguments.steps,
            "kitchens": {kitchen: measure(kitchen) for kitchen in arguments.kitchens},
            "machine": machine(),
        }
        console.print(env_table(found))
        if not contenders.has_peer():
            console.print(INSTALL_PEER, highlight=False)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
