"""Kitchens in which a test sets up a moment by coordinates and plays steps by name."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from envs.overcooked import dynamics
from envs.overcooked.dynamics import State, Transition
from envs.overcooked.layouts import Layout

ITEMS = {"": 0, "onion": 1, "tomato": 2, "dish": 3}
DIRECTIONS = ("north", "south", "east", "west")


def item_code(name: str) -> int:
    """The code of an item: "", "onion", "tomato", "dish", or a soup such as "ooo" or "ot"."""
    return ITEMS[name] if name in ITEMS else dynamics.SOUP + content_code(name)


def content_code(ingredients: str) -> int:
    """The content code of ingredients such as "oot"."""
    assert set(ingredients) <= set("ot"), ingredients
    return 4 * ingredients.count("o") + ingredients.count("t")


@functools.cache
def _compiled_step():
    return jax.jit(dynamics.step, static_argnums=0, static_argnames="old_dynamics")


class DrawnKitchen:
    """A kitchen with a moment in it.

    Args:
        layout: the kitchen.
        style: the partner's style; nothing is forbidden by default.
        old_dynamics: as in `dynamics.step`.
    """

    def __init__(self, layout: Layout, style=None, old_dynamics: bool = False):
        self.layout, self.old_dynamics = layout, old_dynamics
        self.cells = np.ones((2, len(layout.floor)), bool) if style is None else style.cells
        self.targets = np.ones((2, len(layout.stations)), bool) if style is None else style.targets
        self.state: State = dynamics.start_state(layout, None if style is None else style.start)

    def station(self, x: int, y: int) -> int:
        """The index of the station at (x, y)."""
        (found,) = np.flatnonzero((self.layout.stations == (x, y)).all(axis=1))
        return int(found)

    def place(self, agent: int, x: int, y: int, facing: str = "north", held: str = "") -> None:
        """Puts a player onto a cell."""
        state = self.state
        self.state = state.replace(
            cell=state.cell.at[agent].set(self.layout.floor_index(x, y)),
            orientation=state.orientation.at[agent].set(DIRECTIONS.index(facing)),
            held=state.held.at[agent].set(item_code(held)),
        )

    def lay(self, x: int, y: int, item: str) -> None:
        """Lays an item onto a counter."""
        counters = self.state.counters.at[self.station(x, y)].set(item_code(item))
        self.state = self.state.replace(counters=counters)

    def fill(self, x: int, y: int, ingredients: str, timer: int = dynamics.IDLE) -> None:
        """Fills a pot."""
        pot = self.station(x, y) - self.layout.num_counters
        self.state = self.state.replace(
            pot_content=self.state.pot_content.at[pot].set(content_code(ingredients)),
            pot_timer=self.state.pot_timer.at[pot].set(timer),
        )

    def play(self, ego: str = "stay", partner: str = "stay") -> Transition:
        """Plays one step and keeps the state after it."""
        actions = [dynamics.ACTION_NAMES.index(name) for name in (ego, partner)]
        transition = _compiled_step()(
            self.layout,
            self.state,
            jnp.array(actions),
            cells=jnp.asarray(self.cells),
            targets=jnp.asarray(self.targets),
            old_dynamics=self.old_dynamics,
        )
        self.state = transition.after
        return transition

    def cell(self, agent: int) -> tuple[int, int]:
        """Where a player stands."""
        x, y = self.layout.floor[int(self.state.cell[agent])]
        return int(x), int(y)

    def facing(self, agent: int) -> str:
        """The direction that a player faces."""
        return DIRECTIONS[int(self.state.orientation[agent])]

    def held(self, agent: int) -> int:
        """The item code in a player's hands."""
        return int(self.state.held[agent])

    def lying(self, x: int, y: int) -> int:
        """The item code on a counter."""
        return int(self.state.counters[self.station(x, y)])

    def pot(self, x: int, y: int) -> tuple[int, int]:
        """Content and timer of a pot."""
        pot = self.station(x, y) - self.layout.num_counters
        return int(self.state.pot_content[pot]), int(self.state.pot_timer[pot])
