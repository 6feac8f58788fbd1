"""What one player can do alone: who acts, what is kept, what the table says; on a toy."""

import dataclasses

import pytest
from rich.console import Console
from toy_reach import ToyReach

from experiments import alone, training
from experiments.alone import Plan
from haland_jax.ppo_loss import PPOConfig

PLAN = Plan(
    seeds=1,
    games=16,
    training=PPOConfig(
        total_steps=64 * 60,
        num_envs=64,
        rollout_steps=1,
        num_minibatches=2,
        epochs=4,
        learning_rate=3e-3,
        entropy=0.0,
        shaping=0.0,
        confined_until=0.0,
    ),
)


@dataclasses.dataclass(frozen=True)
class OneStep(ToyReach):
    """A game of one step, in which the ego succeeds if it acts and hits its goal."""

    max_steps: int = 1
    still: str | None = None
    success_event = "hit"

    def step(self, key, state, actions, style):
        if self.still is not None:
            actions = actions._replace(**{self.still: 0 * getattr(actions, self.still)})
        return super().step(key, state, actions, style)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    path = tmp_path_factory.mktemp("alone") / "run"
    asked = []

    def make(name, *, still):
        asked.append((name, still))
        return OneStep(still=still)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alone.envs, "make", make)
        return path, asked, alone.measure(path, PLAN)


def test_each_player_is_measured_while_the_other_stays_still(measured):
    _, asked, results = measured
    assert asked == [("assistive/jaco", "partner"), ("assistive/jaco", "ego")]
    robot, person = (results[name]["successes"] for name in ("robot_alone", "person_alone"))
    assert list(robot) == list(person) == ["low", "high"]
    # Success is the ego's, whose goal lies at 0.4 where it stays at 0.
    assert person == {"low": [0.0], "high": [0.0]}
    assert max(max(robot["low"]), max(robot["high"])) > 0


def test_what_is_measured_is_not_measured_again(measured, monkeypatch):
    path, _, results = measured
    monkeypatch.setattr(training, "train_population", None)
    again = alone.measure(path, PLAN)
    for stage in ("robot_alone", "person_alone"):
        assert again[stage]["successes"] == results[stage]["successes"]


def test_the_table_takes_the_best_seed_and_says_what_misses_the_bar():
    found = {
        "machine": {"cpu": "one"},
        "robot_alone": {"successes": {"feed_left": [0.0, 0.1], "feed_right": [0.25, 0.2]}},
        "person_alone": {"successes": {"feed_left": [0.0, 0.0], "feed_right": [0.0, 0.05]}},
    }
    console = Console(record=True, width=100)
    console.print(alone.table_of(found))
    rows = [line.split("│")[1:-1] for line in console.export_text().splitlines() if "│" in line]
    assert [[cell.strip() for cell in row] for row in rows] == [
        ["feed_left", "0.10", "0.00"],
        ["feed_right", "0.25", "0.05"],
        ["highest (bar: at most 0.2)", "0.25", "0.05"],
    ]
