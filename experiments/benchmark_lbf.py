"""Level-based foraging's part of the benchmark: measuring, and the table."""

from typing import Any

from rich.table import Table

from experiments import contenders, contenders_lbf
from experiments.contenders_lbf import ENCODINGS, PEER, PEER_PLAIN

BAR = 10.0
"""Times the speed of Jumanji, with the same kind of observation, that is expected of ours."""
INSTALL_PEER = f"{PEER} is not installed; compare with it after: uv sync --group peers"


def measure_fields(
    encodings: tuple[str, ...], batch: int, steps: int, repeats: int
) -> dict[str, Any]:
    """Steps per second of ours with each observation and of the peer with the same kinds.

    Returns:
        By contender: `kind`, vector or grid, and `steps_per_second`; for ours beside the peer
        also `ratio`, `bar`, `met` and `ratio_to_our_restart`.
    """
    kinds = dict.fromkeys(ENCODINGS[encoding][0] for encoding in encodings)
    entries = [
        (f"ours, {encoding}", ENCODINGS[encoding][0], contenders_lbf.our_fields(encoding))
        for encoding in encodings
    ]
    if contenders_lbf.has_peer():
        entries += [
            (f"{name}, {kind}", kind, contenders_lbf.peer_fields(kind, own_reset=name == PEER))
            for name in (PEER, PEER_PLAIN)
            for kind in kinds
        ]
    programs = {
        name: contenders.compile_games(contender, batch, steps, shared_out=True)
        for name, _, contender in entries
    }
    seconds = contenders.fastest(programs, repeats)
    found: dict[str, Any] = {
        name: {"kind": kind, "steps_per_second": batch * steps / seconds[name]}
        for name, kind, _ in entries
    }
    if contenders_lbf.has_peer():
        for encoding in encodings:
            row = found[f"ours, {encoding}"]
            ratio, plain = (
                row["steps_per_second"] / found[f"{name}, {row['kind']}"]["steps_per_second"]
                for name in (PEER, PEER_PLAIN)
            )
            row |= {"ratio": ratio, "bar": BAR, "met": ratio >= BAR, "ratio_to_our_restart": plain}
    return found


def lbf_table(found: dict[str, Any]) -> Table:
    """The speeds for the terminal."""
    rules, spawning = contenders_lbf.RULES, contenders_lbf.SPAWNING
    table = Table(
        title=f"Foraging, {rules.rows} x {rules.columns}, {spawning.num_players} players, "
        f"{spawning.num_foods} foods, random actions, {found['batch']} games at once",
        caption=", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    )
    for column in ("engine", "kind"):
        table.add_column(column)
    for column in ("steps/s", f"x {PEER}", "bar", "", "x our restart"):
        table.add_column(column, justify="right")
    for name, row in found["engines"].items():
        judged = ()
        if "ratio" in row:
            judged = (
                f"{row['ratio']:.1f}",
                f">= {row['bar']:.0f}",
                "[green]met[/]" if row["met"] else "[red]missed[/]",
                f"{row['ratio_to_our_restart']:.1f}",
            )
        table.add_row(name, row["kind"], f"{row['steps_per_second']:,.0f}", *judged)
    return table
