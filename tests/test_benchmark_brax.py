"""Our learner and Brax's in the same contest, on a toy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_reach import ToyReach

from envs.adapters.brax import BraxEnvironment
from experiments import benchmark_brax
from haland_jax.learner import make_networks
from haland_jax.ppo_loss import PPOConfig

CONFIG = PPOConfig(
    total_steps=PPOConfig().rollout_steps * 8 * 80,
    num_envs=8,
    num_minibatches=2,
    epochs=4,
    learning_rate=3e-3,
    entropy=0.0,
    shaping=0.0,
    confined_until=0.0,
    normalise=True,
)


class Model:
    """What the contest asks of a trained model."""

    def __init__(self):
        self.env = ToyReach()

    def partner(self, style):
        """A partner whose mean action is 0."""
        assert style in self.env.style_names
        actor = make_networks(self.env)[0].partner
        fresh = actor.init(jax.random.key(0), jnp.zeros(self.env.observation_sizes.partner))
        return jax.tree.map(jnp.zeros_like, fresh) | {
            "params": jax.tree.map(jnp.zeros_like, fresh["params"]) | {"log_std": jnp.full(1, -9.0)}
        }


@pytest.mark.slow
def test_both_learners_learn_what_the_style_pays_for():
    told = []
    found = benchmark_brax.measure_learners(
        Model(), "high", CONFIG, seeds=2, games=64, tell=told.append
    )
    assert [line.split(": ")[0] for line in told] == [list(found)[i] for i in (0, 1, 1, 2, 2)]
    assert list(found) == ["ours", "Brax, learning rate 0.003", "Brax, learning rate 0.0009"]
    # The partner loses 0.4² in each of five steps; an ego that does nothing loses as much, and
    # one that plays as it was initialised the variance of its actions besides.
    assert np.mean(found["ours"]["returns"]) > -5 * 2 * 0.16
    assert np.mean(found["Brax, learning rate 0.003"]["returns"]) > -5 * 2 * 0.16 - 1.0
    for row in found.values():
        assert len(row["returns"]) == 2
        assert row["seconds"] > 0
    ours = found["ours"]
    for name in list(found)[1:]:
        row = found[name]
        assert row["time_ratio"] == pytest.approx(row["seconds"] / ours["seconds"])
        assert row["met"] == (np.mean(ours["returns"]) >= np.mean(row["returns"]))
    table = benchmark_brax.brax_table(
        {
            "environment": "toy_reach",
            "style": "high",
            "steps": CONFIG.total_steps,
            "seeds": 2,
            "machine": {},
            "learners": found,
        }
    )
    assert table.row_count == 3


def test_games_are_judged_by_their_whole_return():
    world = BraxEnvironment(ToyReach(), "high", lambda key, seen: jnp.full(1, 0.3))
    returns = benchmark_brax.judge(world, 4, 0, lambda seen, key: (jnp.array([0.2, 1.0]), {}))
    # Five steps of (0.2 - 0.4)² and (0.3 - 0.4)².
    assert returns == pytest.approx(-5 * (0.04 + 0.01), rel=1e-5)


def test_devices_that_cannot_share_the_games_equally_are_refused(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 3)
    with pytest.raises(ValueError, match="there are 3 devices; expected a divisor of 8"):
        benchmark_brax.learner_config("assistive/jaco", 100_000)


def test_the_first_piece_is_not_timed():
    assert benchmark_brax.without_compilation([100.0, 101.0, 103.0, 104.0]) == pytest.approx(16 / 3)


def test_too_short_a_training_is_refused():
    with pytest.raises(ValueError, match=r"steps is 2,000; expected at least 16,000"):
        benchmark_brax.learner_config("assistive/jaco", 2000)
    config = benchmark_brax.learner_config("assistive/jaco", 100_000)
    assert config.num_updates == 60
    assert (config.shaping, config.random_start, config.final_random_start) == (0, 0, 0)
