"""The eight partner styles: what the person wants done, where, and how it holds itself.

Each style leaves the joints little room besides what presenting needs. In the body's whole range
every partner finds a posture of its own, and a robot that knows one cannot help another: an arm was
lifted by 4 to 83 degrees and swung by -48 to 61 by eight partners of one style.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from envs.assistive import model

TASKS = ("scratch", "bathe", "feed", "drink")
HEAD_TURN = 35.0
"""How far the head is turned in the styles of feeding and drinking, degrees; left is positive."""


@dataclasses.dataclass(frozen=True)
class Rule:
    """A style in words and degrees.

    Attributes:
        task: one of `TASKS`.
        limb: where the itch is: `upper_arm` or `forearm`.
        downwards: whether the arm is bathed from the shoulder down, not from the wrist up.
        head_turn: how far the head is turned when the person presents its mouth, degrees.
        ranges: joint ranges of the person that are narrower than its body's, degrees.
    """

    task: str
    limb: str = "upper_arm"
    downwards: bool = True
    head_turn: float = 0.0
    ranges: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)


_ELBOW = {"elbow": (-18.0, -12.0)}
_ARM_SHOWN = {
    "shoulder_y": (5.0, 38.0),
    "shoulder_x": (-5.0, 3.0),
    "shoulder_z": (-40.0, 70.0),
    "head_x": (-3.0, 3.0),
    "head_z": (-3.0, 3.0),
    **_ELBOW,
}
_ARM_RESTS = {
    "shoulder_y": (12.0, 18.0),
    "shoulder_x": (-3.0, 3.0),
    "shoulder_z": (-3.0, 3.0),
    "head_x": (-3.0, 3.0),
    **_ELBOW,
}
_ARM_BATHED = {**_ARM_SHOWN, "shoulder_z": (-3.0, 3.0)}
_LEFT = {**_ARM_RESTS, "head_z": (-5.0, 36.0)}
_RIGHT = {**_ARM_RESTS, "head_z": (-36.0, 5.0)}

RULES = {
    "scratch_upper_arm": Rule("scratch", limb="upper_arm", ranges=_ARM_SHOWN),
    "scratch_forearm": Rule("scratch", limb="forearm", ranges=_ARM_SHOWN),
    "bathe_down": Rule("bathe", downwards=True, ranges=_ARM_BATHED),
    "bathe_up": Rule("bathe", downwards=False, ranges=_ARM_BATHED),
    "feed_left": Rule("feed", head_turn=HEAD_TURN, ranges=_LEFT),
    "feed_right": Rule("feed", head_turn=-HEAD_TURN, ranges=_RIGHT),
    "drink_left": Rule("drink", head_turn=HEAD_TURN, ranges=_LEFT),
    "drink_right": Rule("drink", head_turn=-HEAD_TURN, ranges=_RIGHT),
}


class Style(PyTreeNode):
    """A style as arrays; leading axis [style] when stacked.

    Attributes:
        one_hot: which of all eight styles it is; part of the partner's observation, float32 [8].
        task: number of the task in `TASKS`, int32 [].
        forearm: whether the itch is on the forearm, bool [].
        downwards: whether the arm is bathed from the shoulder down, bool [].
        head_turn: of the presented mouth, rad [].
        ranges: lower and upper limit of every joint, rad [joint, 2].
    """

    one_hot: jnp.ndarray
    task: jnp.ndarray
    forearm: jnp.ndarray
    downwards: jnp.ndarray
    head_turn: jnp.ndarray
    ranges: jnp.ndarray


def style_names(tasks: Sequence[str] = TASKS) -> tuple[str, ...]:
    """Names of the styles of some tasks."""
    return tuple(name for name, rule in RULES.items() if rule.task in tasks)


def all_styles(tasks: Sequence[str] = TASKS) -> Style:
    """Returns the styles of some tasks stacked, leading axis [style]."""
    names = style_names(tasks)
    rules = [RULES[name] for name in names]
    places = [list(RULES).index(name) for name in names]
    return Style(
        one_hot=jnp.eye(len(RULES))[np.array(places)],
        task=jnp.array([TASKS.index(rule.task) for rule in rules], jnp.int32),
        forearm=jnp.array([rule.limb == "forearm" for rule in rules]),
        downwards=jnp.array([rule.downwards for rule in rules]),
        head_turn=jnp.radians(jnp.array([rule.head_turn for rule in rules])),
        ranges=jnp.array(np.stack([_ranges(rule) for rule in rules]), jnp.float32),
    )


def _ranges(rule: Rule) -> np.ndarray:
    ranges = model.joint_ranges().copy()
    for joint, degrees in rule.ranges.items():
        ranges[model.JOINTS.index(joint)] = np.radians(degrees)
    return ranges
