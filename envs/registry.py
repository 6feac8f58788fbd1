"""Environments by name."""

from collections.abc import Callable
from typing import Any

from envs.base import DrawnEnvironment
from envs.lbf.env import make_lbf
from envs.overcooked.env import make_overcooked
from envs.overcooked.layouts import CLASSIC, STYLED


def _make_assistive(robot: str, **options: Any) -> Any:
    # MuJoCo and MJX take seconds to import, which those who cook need not wait for.
    from envs.assistive.env import make_assistive

    return make_assistive(robot, **options)


_FAMILIES: dict[str, tuple[tuple[str, ...], Callable[..., Any]]] = {
    "overcooked": (STYLED + CLASSIC, make_overcooked),
    "lbf": (("spread",), make_lbf),
    "assistive": (("jaco",), _make_assistive),
}


def names(*, styled_only: bool = False) -> tuple[str, ...]:
    """Returns the names that `make` knows.

    Args:
        styled_only: leave out environments without partner styles.
    """
    found = [f"{family}/{name}" for family, (members, _) in _FAMILIES.items() for name in members]
    classic = {f"overcooked/{name}" for name in CLASSIC}
    return tuple(name for name in found if not (styled_only and name in classic))


def make(name: str, **options) -> DrawnEnvironment:
    """Makes an environment, such as `overcooked/center_pots`.

    Args:
        name: family and member; see `names`.
        options: options of the family, such as `encoding="grid"`.

    Raises:
        ValueError: no environment of that name.
    """
    family, _, member = name.partition("/")
    members, maker = _FAMILIES.get(family, ((), None))
    if maker is None or member not in members:
        raise ValueError(f"unknown environment {name!r}; expected one of {', '.join(names())}")
    return maker(member, **options)
