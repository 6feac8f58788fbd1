"""Two-player games in pure JAX, with partners of several styles."""

from envs.base import AGENTS as AGENTS
from envs.base import Environment as Environment
from envs.base import Pair as Pair
from envs.base import TimeStep as TimeStep
from envs.registry import make as make
from envs.registry import names as names
