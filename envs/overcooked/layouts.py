"""Kitchens: reading overcooked-ai's text notation into index tables.

A cell is written as in overcooked-ai: `X` counter, `P` pot, `O` onions, `T` tomatoes,
`D` dishes, `S` serving, space floor, `1` and `2` the players' start cells. Player 1 is
the ego. Coordinates are (x, y) from the top left.
"""

import dataclasses
import functools
from importlib import resources

import numpy as np

STATION_KINDS = "XPOTDS"
COUNTER, POT, ONIONS, TOMATOES, DISHES, SERVING, NOTHING = range(7)
# overcooked-ai's order of directions: north, south, east, west.
DIRECTIONS = np.array([(0, -1), (0, 1), (1, 0), (-1, 0)])

CLASSIC = (
    "cramped_room",
    "asymmetric_advantages",
    "coordination_ring",
    "forced_coordination",
    "counter_circuit",
)
STYLED = ("center_pots", "crossway", "diverse_coordination", "diverse_orders")


@dataclasses.dataclass(frozen=True, eq=False)
class Layout:
    """A kitchen as constants of a compiled program.

    Attributes:
        terrain: rows of the kitchen, without the players.
        floor: (x, y) of each floor cell, int [F, 2].
        stations: (x, y) of each reachable cell that is not floor, int [K, 2]; counters
            first, then pots, onions, tomatoes, dishes, serving cells.
        kinds: kind of each station and, last, of "no station", int [K + 1].
        start: start cell of each player, int [agent], an index into `floor`.
        neighbour: floor cell reached from a cell in a direction; the cell itself where
            the way is blocked, int [F, 4].
        facing: station faced from a cell in a direction; K where there is none, int [F, 4].
        orders: contents (4 * onions + tomatoes) of the soups that pay.
        cook_time: steps from start to ready.
        soup_reward: what an ordered soup pays.
    """

    name: str
    terrain: tuple[str, ...]
    floor: np.ndarray
    stations: np.ndarray
    kinds: np.ndarray
    start: np.ndarray
    neighbour: np.ndarray
    facing: np.ndarray
    orders: tuple[int, ...]
    cook_time: int = 20
    soup_reward: float = 20.0

    @property
    def height(self) -> int:
        """Number of rows."""
        return len(self.terrain)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.terrain[0])

    @property
    def station_kinds(self) -> str:
        """Kind of each station as its letter, length K."""
        return "".join(STATION_KINDS[kind] for kind in self.kinds[:-1])

    @property
    def num_counters(self) -> int:
        """Number of reachable counters C; they are the first stations."""
        return int(np.sum(self.kinds == COUNTER))

    @property
    def num_pots(self) -> int:
        """Number of pots P; they follow the counters."""
        return int(np.sum(self.kinds == POT))

    @property
    def has_tomatoes(self) -> bool:
        """Whether the kitchen has a tomato dispenser."""
        return bool(np.any(self.kinds == TOMATOES))

    def floor_index(self, x: int, y: int) -> int:
        """Returns the index of the floor cell at (x, y); ValueError if it is not floor."""
        found = np.flatnonzero((self.floor == (x, y)).all(axis=1))
        if not found.size:
            raise ValueError(f"({x}, {y}) is not a floor cell of kitchen {self.name!r}")
        return int(found[0])

    def stations_beside(self, cells: np.ndarray) -> np.ndarray:
        """Returns which stations touch the floor cells of a mask [F], bool [K]."""
        touched = np.zeros(len(self.stations) + 1, bool)
        touched[self.facing[cells].ravel()] = True
        return touched[:-1]


def parse_layout(name: str, text: str) -> Layout:
    """Reads a kitchen from its text notation.

    Args:
        name: name of the kitchen, for messages.
        text: one line a row.

    Raises:
        ValueError: ragged rows, an unknown letter, an open border, a missing player, pot,
            dish dispenser, serving cell or ingredient.
    """
    rows = [line for line in text.splitlines() if line.strip()]
    _check_rows(name, rows)
    letters = np.array([list(row) for row in rows])
    starts = [tuple(np.argwhere(letters == player)[0][::-1]) for player in "12"]
    letters[np.isin(letters, ["1", "2"])] = " "

    floor = np.argwhere(letters == " ")[:, ::-1]
    floor_index = {tuple(cell): i for i, cell in enumerate(floor)}
    beside_floor = {tuple(cell + step) for cell in floor for step in DIRECTIONS}
    stations = [
        (x, y)
        for kind in STATION_KINDS
        for y, x in np.argwhere(letters == kind)
        if (x, y) in beside_floor
    ]
    station_index = {cell: i for i, cell in enumerate(stations)}
    kinds = [STATION_KINDS.index(str(letters[y, x])) for x, y in stations]

    neighbour = np.zeros((len(floor), 4), np.int32)
    facing = np.full((len(floor), 4), len(stations), np.int32)
    for i, cell in enumerate(floor):
        for direction, step in enumerate(DIRECTIONS):
            there = tuple(cell + step)
            neighbour[i, direction] = floor_index.get(there, i)
            facing[i, direction] = station_index.get(there, len(stations))
    three_tomatoes = (3,) if TOMATOES in kinds else ()
    return Layout(
        name=name,
        terrain=tuple("".join(row) for row in letters),
        floor=floor,
        stations=np.array(stations),
        kinds=np.array([*kinds, NOTHING], np.int32),
        start=np.array([floor_index[cell] for cell in starts], np.int32),
        neighbour=neighbour,
        facing=facing,
        orders=(12, *three_tomatoes),
    )


def _check_rows(name: str, rows: list[str]) -> None:
    if not rows or len({len(row) for row in rows}) != 1:
        raise ValueError(f"kitchen {name!r}: all rows must have the same length")
    letters = "".join(rows)
    unknown = set(letters) - set("XPOTDS 12")
    if unknown:
        raise ValueError(f"kitchen {name!r}: unknown letters {sorted(unknown)}")
    border = rows[0] + rows[-1] + "".join(row[0] + row[-1] for row in rows)
    if set(border) & set(" 12"):
        raise ValueError(f"kitchen {name!r}: the border must hold no floor cell")
    for player in "12":
        if letters.count(player) != 1:
            raise ValueError(f"kitchen {name!r}: player {player} must stand on exactly one cell")
    for needed, what in (("P", "pot"), ("D", "dish dispenser"), ("S", "serving cell")):
        if needed not in letters:
            raise ValueError(f"kitchen {name!r} needs at least one {what} ({needed})")
    if not set(letters) & set("OT"):
        raise ValueError(f"kitchen {name!r} needs onions (O) or tomatoes (T)")


@functools.cache
def load_layout(name: str) -> Layout:
    """Reads one of the kitchens that come with the package.

    Raises:
        ValueError: no kitchen of that name.
    """
    if name not in STYLED + CLASSIC:
        raise ValueError(f"unknown kitchen {name!r}; expected one of {', '.join(STYLED + CLASSIC)}")
    text = resources.files("envs.overcooked").joinpath(f"layouts/{name}.layout").read_text()
    return parse_layout(name, text)
