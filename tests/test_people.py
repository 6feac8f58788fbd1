"""What people thought of agents: by hand, and as figures."""

import sys

import numpy as np
import pytest

from envs.base import Pair
from experiments import people
from experiments.errors import UserError
from experiments.study import recording
from experiments.study.rounds import Recorded
from experiments.study.store import Begun, Store
from experiments.study.tables import FINISHED


def played(who, condition, score, rating=None, environment="overcooked/crossway"):
    nothing = np.zeros(1, np.int32)
    return Recorded(
        who, condition, environment, "upper_left", 0, rating, Pair(nothing, nothing),
        np.array([score], np.float32),
    )  # fmt: skip


ROUNDS = [
    played("a", "haland", 100.0, 5),
    played("a", "haland", 60.0, 3),
    played("a", "oracle", 40.0, 1),
    played("b", "haland", 20.0, 2),
    played("b", "oracle", 40.0, 4),
    played("c", "universal", 10.0, 1),
    played("c", "oracle", 40.0),
]


def test_every_participant_counts_once():
    found = people.opinions(ROUNDS)
    assert list(found) == ["haland", "oracle", "universal"]
    haland = found["haland"]
    assert (haland.rounds, haland.people) == (3, 2)
    assert haland.score.value == pytest.approx((80 + 20) / 2)
    # Two people say little: 30 * sqrt(2 / 1) * 12.706 / 1.960 on each side.
    assert haland.score.low == pytest.approx(50 - 275.05, abs=0.01)
    assert haland.score.high == pytest.approx(50 + 275.05, abs=0.01)
    assert haland.rating is not None
    assert haland.rating.value == pytest.approx((4 + 2) / 2)
    assert found["oracle"].score == pytest.approx((40, 40, 40))
    assert people.opinions([played("a", "haland", 1.0)])["haland"].rating is None


def test_preferences_are_of_the_same_people():
    names, values = people.preferences(ROUNDS)
    assert names == ["haland", "oracle", "universal"]
    # a rated Haland 4 and the Oracle 1, b rated them 2 and 4; c rated the universal ego alone.
    assert values[0, 1] == pytest.approx(((4 - 1) + (2 - 4)) / 2)
    np.testing.assert_allclose(values, -values.T)
    assert np.isnan(values[0, 2])
    assert values[2, 2] == 0


def test_figures_from_a_database(monkeypatch, capsys, database_url, tmp_path):
    store = Store(database_url)
    participant, _ = store.enrol(lambda _: [])
    for number, condition in enumerate(("haland", "oracle")):
        begun = Begun(
            number, condition, "lbf/spread", "m", "f", "level_1", "one", "level_1", 0, 0, b"", 6.0
        )
        one = store.begin_round(participant.id, begun)
        store.add_steps([(one, 0, recording.pack([(0, 0, 1.0, 0.0)]))])
        store.end_round(one, FINISHED)
        store.rate(one, 5 - number, "")
    store.close()
    monkeypatch.setattr(sys, "argv", ["command", database_url, "--out", str(tmp_path / "drawn")])
    with pytest.raises(SystemExit) as stopped:
        people.main()
    assert not stopped.value.code
    said = capsys.readouterr().out
    assert "lbf/spread with people" in said
    for name in ("figure_7b", "figure_7c"):
        assert (tmp_path / "drawn" / f"{name}.png").stat().st_size > 5000
        assert (tmp_path / "drawn" / f"{name}.pdf").read_bytes().startswith(b"%PDF")


def test_which_environment_is_meant_has_to_be_clear():
    both = [*ROUNDS, played("d", "haland", 1.0, environment="lbf/spread")]
    with pytest.raises(UserError, match="rounds of lbf/spread, overcooked/crossway; name one"):
        people.of_one_environment(both, None)
    assert people.of_one_environment(both, "lbf/spread") == both[-1:]
    assert people.of_one_environment(ROUNDS, None) == ROUNDS
