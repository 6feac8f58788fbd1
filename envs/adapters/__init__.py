"""The environments as other packages know them; each adapter is imported by itself.

from envs.adapters.jaxmarl import JaxMARLEnvironment
from envs.adapters.pettingzoo import PettingZooEnvironment
from envs.adapters.brax import BraxEnvironment
"""
