"""The paper's figures: numbers by hand, and what is left out."""

import json

import numpy as np
import pytest
from made_up_results import STYLES, made_up_results
from refused_command import refused

from experiments import intervals, standing, summary
from experiments.figures import __main__ as command
from experiments.figures import paper


def two_runs() -> list[dict]:
    first = made_up_results(others=("General Ego", "My method"))
    second = {**made_up_results(), "environment": "lbf/spread"}
    return [first, second]


def test_figure_3_compares_what_is_comparable():
    runs = two_runs()
    assert standing.compared(runs) == [
        summary.HEADLINE, "General Ego", *summary.COMPARISONS, "My method"
    ]  # fmt: skip
    axes = paper.normalised_returns(runs).axes[0]
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names == ["diverse coordination", "spread", "all"]
    bars = [c for c in axes.containers if hasattr(c, "patches")]
    assert [len(one.patches) for one in bars] == [3, 1, 3, 3, 1], "who was not measured has no bar"
    for bar, run in zip(bars[0].patches, runs, strict=False):
        expected = intervals.interquartile_mean(summary.ratios(run, summary.HEADLINE))
        assert bar.get_height() == pytest.approx(float(expected))


def test_runs_with_different_numbers_of_seeds_are_joined():
    one, other = two_runs()
    for by_style in other["methods"].values():
        for style in STYLES:
            by_style[style]["returns"] = by_style[style]["returns"][:1]
    other["oracle"] = {style: seeds[:1] for style, seeds in other["oracle"].items()}
    found = standing.estimates([one, other], summary.HEADLINE)
    both = [summary.ratios(run, summary.HEADLINE).ravel() for run in (one, other)]
    assert found is not None
    assert found.value == pytest.approx(float(intervals.interquartile_mean(np.concatenate(both))))
    assert standing.estimates([one, other], "General Ego") is None


def test_universal_egos_are_drawn_by_their_steps():
    results = made_up_results()
    assert not paper.FIGURES["universal_learning"].runs(results)
    curves = {"General Ego": [[1.0, 3.0], [2.0, 6.0]], "Adaptive Ego": [[0.0, 1.0], [0.0, 1.0]]}
    results["compared"] = {
        "universal": {"curve_steps": [2e6, 4e6], "curve_returns": curves},
        "no-vae": {"by_ego": {}},
    }
    assert paper.FIGURES["universal_learning"].runs(results)
    general, adaptive = paper.universal_learning(results).axes[0].lines
    assert general.get_label() == "General Ego"
    np.testing.assert_allclose(general.get_xydata(), [[2.0, 1.5], [4.0, 4.5]])
    assert general.get_marker() != adaptive.get_marker(), "to be told apart in grey"


def test_figure_4_has_a_row_for_every_seed_of_the_adaptive_ego():
    results = made_up_results()
    played = np.arange(8 * 6, dtype=float).reshape(8, 6)  # seeds 0, 1, 2, 0, 1, 2
    results["compared"] = {
        "universal": {"seeds": 3, "by_ego": {standing.ADAPTIVE: played.tolist()}}
    }
    axes = paper.adaptive_egos(results).axes[0]
    shown = np.array([float(text.get_text()) for text in axes.texts]).reshape(4, 8)
    oracle = [np.mean(results["oracle"][style]) for style in STYLES]
    np.testing.assert_allclose(shown[0], oracle, atol=0.5)
    np.testing.assert_allclose(shown[2], (played[:, 1] + played[:, 4]) / 2, atol=0.5)


def test_table_1_by_hand():
    results = {
        "environment": "a/b",
        "styles": ["one", "two"],
        "oracle": {"one": [10.0, 20.0], "two": [4.0, 4.0]},
        "methods": {
            summary.HEADLINE: {"one": {"returns": [10.0, 18.0]}, "two": {"returns": [4.0, 2.0]}},
            "CGAN (UNet)": {"one": {"returns": [0.0, 0.0]}, "two": {"returns": [1.0, 3.0]}},
        },
    }
    rows = [line.strip("|").split("|") for line in paper.table_1(results).splitlines()]
    cells = [[cell.strip() for cell in row] for row in rows]
    assert cells[0] == ["partner", "Oracle", "Haland, test sentences", "CGAN (UNet)"]
    assert cells[2] == ["one", "15.0 ± 7.1", "14.0 ± 5.7", "0.0 ± 0.0"]
    assert cells[-1] == ["**return / Oracle**", "1.00", "0.85", "0.25"]


def test_the_improvement_by_hand():
    def run(ours, *theirs):
        methods = {summary.HEADLINE: {"s": {"returns": [ours]}}}
        methods |= {
            name: {"s": {"returns": [value]}}
            for name, value in zip(standing.EGOS, theirs, strict=False)
        }
        return {"styles": ["s"], "oracle": {"s": [10.0]}, "methods": methods}

    # Beside the best: 10 / 5 - 1 = 1, 9 / 9 - 1 = 0 and 9 / 5 - 1 = 0.8. Beside each: 1 and 4, 0
    # and 2, 0.8 alone; environments count alike, however many egos they have.
    runs = [run(10.0, 5.0, 2.0), run(9.0, 9.0, 3.0), run(9.0, 5.0), run(1.0)]
    found = standing.improvement(map(standing.gain, runs))
    assert found is not None
    assert found.best == pytest.approx(0.6)
    assert found.median == pytest.approx(0.8)
    assert found.each == pytest.approx((2.5 + 1.0 + 0.8) / 3)
    said = standing.improvement_in_words(map(standing.gain, runs))
    assert "+60.0% beside the best" in said
    assert "(median +80.0%)" in said
    assert "over 3 environments" in said
    assert "+143.3% beside each" in said
    # Beside an ego that loses there is no share: it is left out, and nothing is said of it alone.
    losing = standing.gain(run(5.0, 4.0, -1.0))
    assert losing is not None
    np.testing.assert_allclose(losing, [0.25, 0.25])
    assert standing.improvement_in_words([standing.gain(run(5.0, -1.0)), None]) == ""


def test_two_processes_draw_what_one_does(tmp_path):
    names = ("figure_3", "figure_8_to_11")
    alone = paper.draw_paper(two_runs(), tmp_path / "one", names)
    together = paper.draw_paper(two_runs(), tmp_path / "two", names, processes=2)
    assert [len(files) for files in alone.values()] == [1, 2]
    assert list(together) == list(alone)
    for name in names:
        for one, other in zip(alone[name], together[name], strict=True):
            assert other.name == one.name
            assert other.read_bytes() == one.read_bytes()


def test_folders_that_are_no_runs_are_refused(capsys, monkeypatch, tmp_path):
    assert "name at least one run" in refused(capsys, monkeypatch, command)
    assert "cannot be read" in refused(capsys, monkeypatch, command, tmp_path)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(made_up_results()))
    line = refused(capsys, monkeypatch, command, tmp_path / "one", tmp_path / "two")
    assert "another run of overcooked/diverse_coordination" in line
    (tmp_path / "one" / "results.json").write_text("{")
    assert "is damaged" in refused(capsys, monkeypatch, command, tmp_path / "one")
