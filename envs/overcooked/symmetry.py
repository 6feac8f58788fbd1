"""In which mirrors a kitchen looks the same, and what becomes of a partner there.

All four styled kitchens have one such mirror: `crossway` turned by half, the others with left
and right exchanged, `diverse_orders` also with onions for tomatoes.
"""

import itertools
from collections.abc import Callable

import numpy as np

from envs.base import Symmetry
from envs.overcooked import layouts, observation
from envs.overcooked.layouts import DIRECTIONS, STATION_KINDS, Layout
from envs.overcooked.styles import Style

Place = Callable[[np.ndarray], np.ndarray]
"""From (x, y), int [..., 2], to where that is in the mirror."""


def find_symmetries(layout: Layout, styles: Style) -> tuple[Symmetry, ...]:
    """Returns every mirror, but the identity, that maps the kitchen and its styles to themselves.

    Args:
        layout: the kitchen.
        styles: all styles stacked, leading axis [style].
    """
    corner = np.array([layout.width - 1, layout.height - 1])
    found = []
    for across, down, swap in itertools.product((False, True), repeat=3):
        if not (across or down or swap):
            continue
        flip = np.array([across, down])
        mirror = _Mirror(
            layout, lambda place, flip=flip: np.where(flip, corner - place, place), swap
        )
        if mirror.keeps_the_kitchen:
            images = mirror.style_images(styles)
            if images is not None:
                found.append(
                    Symmetry(images, mirror.features(styles.task.shape[-1]), mirror.actions)
                )
    return tuple(found)


class _Mirror:
    """One candidate: where each cell, station, item, feature and action is in the mirror."""

    def __init__(self, layout: Layout, image: Place, swap: bool):
        self.layout, self.swap = layout, swap
        terrain = np.array([list(row) for row in layout.terrain])
        letters = _exchanged(terrain, "O", "T") if swap else terrain
        y, x = np.indices(terrain.shape)
        image_x, image_y = np.moveaxis(image(np.stack([x, y], axis=-1)), -1, 0)
        seen = terrain[image_y, image_x]
        self.keeps_the_kitchen = bool((seen == letters).all()) and (not swap or layout.has_tomatoes)
        if self.keeps_the_kitchen:
            self.cells = _index_of(image(layout.floor), layout.floor)
            self.stations = _index_of(image(layout.stations), layout.stations)
        origin = image(np.zeros(2, int))
        self.directions = _index_of(image(DIRECTIONS) - origin, DIRECTIONS)

    @property
    def actions(self) -> np.ndarray:
        """Of each action: four ways, stay, interact; int [6]."""
        return np.concatenate([self.directions, [4, 5]])

    @property
    def contents(self) -> np.ndarray:
        """Of each content code, 4 * onions + tomatoes; int [16]."""
        codes = np.arange(16)
        return 4 * (codes & 3) + (codes >> 2) if self.swap else codes

    def style_images(self, styles: Style) -> np.ndarray | None:
        """As which style each style appears, int [style]; None if some appears as no style."""
        arrays = [np.asarray(part) for part in (styles.cells, styles.targets, styles.pays)]
        cells, targets, pays = (np.empty_like(part) for part in arrays)
        cells[:, :, self.cells] = arrays[0]
        targets[:, :, self.stations] = arrays[1]
        pays[:, self.stations[:, None], self.contents] = arrays[2]
        same = [
            (mirrored[:, None] == own[None]).reshape(len(own), len(own), -1).all(axis=-1)
            for mirrored, own in zip((cells, targets, pays), arrays, strict=True)
        ]
        same = np.logical_and.reduce(same)
        return same.argmax(axis=1) if (same.sum(axis=1) == 1).all() else None

    def features(self, task_size: int) -> np.ndarray:
        """Of each number of the partner's feature vector; int [O]."""
        layout = self.layout
        items = np.arange(6 if layout.has_tomatoes else 4)
        kinds = np.arange(len(STATION_KINDS) + 1)
        pot = np.arange(5)
        if self.swap:
            items, pot = _exchanged(_exchanged(items, 0, 1), 4, 5), _exchanged(pot, 0, 1)
            kinds = _exchanged(kinds, layouts.ONIONS, layouts.TOMATOES)
        counters = self.stations[: layout.num_counters]
        pots = self.stations[layout.num_counters :][: layout.num_pots] - layout.num_counters
        parts = {
            "own_cell": self.cells,
            "other_cell": self.cells,
            "own_orientation": self.directions,
            "other_orientation": self.directions,
            "own_held": items,
            "other_held": items,
            "faced_kind": kinds,
            "faced_item": items,
            "pots": (len(pot) * pots[:, None] + pot).ravel(),
            "counters": (len(items) * counters[:, None] + items).ravel(),
        }
        slices = observation.feature_slices(layout)
        where = np.arange(observation.num_features(layout))
        for name, part in parts.items():
            where[slices[name]] = slices[name].start + part
        return np.concatenate([where, len(where) + self._task(task_size)])

    def _task(self, size: int) -> np.ndarray:
        """Of the task: onions, tomatoes, then the serving cells from the left."""
        if not size:
            return np.zeros(0, int)
        layout = self.layout
        serving = np.flatnonzero(np.array(list(layout.station_kinds)) == "S")
        by_column = serving[np.argsort(layout.stations[serving, 0], kind="stable")]
        order = _exchanged(np.arange(2), 0, 1) if self.swap else np.arange(2)
        places = _index_of(self.stations[by_column][:, None], by_column[:, None])
        return np.concatenate([order, 2 + places])


def _index_of(rows: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Where each row is found in a table of the same rows in another order, int [len(rows)]."""
    return (rows[:, None] == table[None]).all(axis=-1).argmax(axis=1)


def _exchanged(array: np.ndarray, one: str | int, other: str | int) -> np.ndarray:
    """The array with two of its values exchanged."""
    return np.where(array == one, other, np.where(array == other, one, array))
