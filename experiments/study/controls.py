"""Which key does what in each family of environments, and what a player's hands say at a tick."""

import dataclasses
from collections import deque

UP, DOWN, LEFT, RIGHT, ACT = "up", "down", "left", "right", "act"
BUTTONS = (UP, DOWN, LEFT, RIGHT, ACT)
"""What keyboard and touch pad have; the page says which is pressed and let go."""


@dataclasses.dataclass(frozen=True)
class Controls:
    """The buttons of a family of environments.

    Attributes:
        stay: the action of a player who presses nothing.
        actions: the action of each button.
        once: buttons that act once a press, however long they are held.
        act: what the last button does, for the page.
    """

    stay: int
    actions: dict[str, int]
    once: frozenset[str]
    act: str


CONTROLS = {
    "overcooked": Controls(
        stay=4,
        actions={UP: 0, DOWN: 1, RIGHT: 2, LEFT: 3, ACT: 5},
        once=frozenset({ACT}),
        act="take, put, cook, serve",
    ),
    "lbf": Controls(
        stay=0,
        actions={UP: 1, DOWN: 2, LEFT: 3, RIGHT: 4, ACT: 5},
        once=frozenset(),
        act="lift (both at once)",
    ),
}


def controls_of(environment: str) -> Controls:
    """The buttons of an environment.

    Raises:
        ValueError: nobody has said which keys it is played with.
    """
    family = environment.split("/")[0]
    if family not in CONTROLS:
        raise ValueError(
            f"{environment} cannot be played with keys; expected one of {', '.join(CONTROLS)}"
        )
    return CONTROLS[family]


class Hands:
    """The buttons that a player holds or has pressed since the last tick.

    A button pressed and let go between two ticks still counts, and the last one held goes on.
    """

    def __init__(self, controls: Controls):
        """Hands that press nothing."""
        self._controls = controls
        self._held: list[str] = []
        self._pressed: deque[str] = deque(maxlen=2)

    def press(self, button: str) -> None:
        """A button goes down."""
        self._pressed.append(button)
        if button not in self._controls.once and button not in self._held:
            self._held.append(button)

    def release(self, button: str) -> None:
        """A button goes up."""
        if button in self._held:
            self._held.remove(button)

    def let_go(self) -> None:
        """All buttons go up, as when the page is left."""
        self._held.clear()
        self._pressed.clear()

    def act(self) -> int:
        """The action of this tick."""
        if self._pressed:
            button = self._pressed.popleft()
        elif self._held:
            button = self._held[-1]
        else:
            return self._controls.stay
        return self._controls.actions[button]
