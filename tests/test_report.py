"""The report says what results.json says, the bad news included."""

import re

import numpy as np
import pytest
from made_up_results import STYLES, made_up_results
from rich.console import Console

from experiments import report, summary

pytestmark = pytest.mark.usefixtures("no_drawing")


def test_the_report_holds_the_numbers(tmp_path):
    results = made_up_results(others=("General",))
    results["descriptions"] = {"General": "one ego for all styles"}
    text = report.write_report(results, tmp_path).read_text()
    for row in summary.summarise(results):
        line = next(line for line in text.splitlines() if line.startswith(f"| {row.method} |"))
        assert f"{row.mean:.1f} ± {row.std:.1f}" in line
        assert f"{row.ratio:.3f} ± {row.ratio_std:.3f}" in line
    assert re.search(r"\| General \|.*\| one ego for all styles \|", text)
    assert re.search(r"Haland, test sentences \|.*\| 64 \|", text)  # 8 styles, 2 seeds, 4 episodes
    assert "| best responses on held-out partners | 0.96 | ≥ 0.9 | met |" in text
    assert "| VAE reconstruction, worst policy | 0.93 | ≥ 0.95 | **missed** |" in text
    assert "Gates missed: VAE reconstruction, worst policy" in text
    assert "94% of the test sentences" in text
    assert "left no onion 50%" in text
    assert "| **all** | **557.0** |" in text
    assert "![returns by style](figures/returns_by_style.png)" in text
    assert "| nearest training latent distance | 3.2 |" in text


def section(text: str, title: str) -> str:
    return text.split(f"## {title}\n\n")[1].split("\n## ")[0]


def with_shares(results: dict, shares: dict[str, float]) -> dict:
    """The results with methods that earn a fixed share of each partner's Oracle."""
    for method, factor in shares.items():
        for style in STYLES:
            results["methods"][method][style]["returns"] = [
                [factor * value] for value in results["oracle"][style]
            ]
    return results


def test_successes_are_shown_where_games_can_succeed(tmp_path):
    results = made_up_results()
    assert "| success |" not in report.write_report(results, tmp_path).read_text()
    for method in results["methods"].values():
        for index, style in enumerate(STYLES):
            method[style]["successes"] = [1.0, 0.5] if index == 0 else [0.0, 0.0]
    returns = section(report.write_report(results, tmp_path).read_text(), "Returns")
    assert "| success |" in returns
    (haland,) = [line for line in returns.splitlines() if line.startswith(f"| {summary.HEADLINE}")]
    assert f"| {0.75 / len(STYLES):.0%} |" in haland


@pytest.mark.parametrize(
    ("told", "haland", "expected"),
    [
        (0.8, 0.9, ("the label is worth something", "(90%) is ahead of", "two: +0.10 [")),
        (0.61, 0.5, ("hardly changes", "(50%) is behind", "two: -0.11 [")),
        (0.4, 0.9, ("optimisation, not information", "(90%) is ahead of", "two: +0.30 [")),
    ],
)
def test_what_the_style_is_worth_is_said_in_words(tmp_path, told, haland, expected):
    shares = {
        summary.UNIVERSAL: 0.6,
        summary.UNIVERSAL_WITH_LABEL: told,
        summary.HEADLINE: haland,
    }
    results = with_shares(made_up_results(), shares)
    results["cross_play"] = (np.full((8, 8), 50.0) + 150 * np.eye(8)).tolist()
    said = section(report.write_report(results, tmp_path).read_text(), "What the style is worth")
    assert "200.0 with held-out partners of their own style" in said
    assert "50.0 with those of other styles, 25% of that." in said
    assert "for 1.5 M steps" in said
    assert "(60% of the Oracle) without the style's label" in said
    assert f"({told:.0%}) with it; all archived best responses together took 52.8 M" in said
    for phrase in expected:
        assert phrase in said
    assert "![cross play](figures/cross_play.png)" in said


def test_the_universal_egos_are_listed_with_their_budget(tmp_path):
    text = report.write_report(made_up_results(), tmp_path).read_text()
    line = next(line for line in text.splitlines() if line.startswith("| Universal ego |"))
    assert "(1.5 M steps), without the style's label" in line
    assert "| Universal ego with the style's label |" in section(text, "By style").split("\n")[0]


@pytest.mark.parametrize(
    ("share", "wrong", "expected"),
    [
        (0.97, 0.3, ("97% of the Oracle", "reaches the aim", "the sentence matters")),
        (0.99, 0.71, ("99% of the Oracle", "reaches the aim", "another style gets far here")),
        (0.80, 0.78, ("80% of the Oracle", "misses the aim", "hardly matters")),
    ],
)
def test_the_verdict_follows_the_numbers(tmp_path, share, wrong, expected):
    results = with_shares(made_up_results(), {summary.HEADLINE: share, summary.WRONG: wrong})
    text = report.write_report(results, tmp_path).read_text()
    for phrase in expected:
        assert phrase in text.split("## Returns")[0]


def test_dead_partners_are_confessed(tmp_path):
    results = made_up_results()
    results["oracle"]["left_no_dish"] = [0.0, 100.0]
    text = report.write_report(results, tmp_path).read_text()
    assert "1 held-out partners whose Oracle is zero or less" in text


def test_parts_that_were_not_measured_are_left_out(tmp_path):
    results = made_up_results()
    for key in ("gates", "translator", "times", "machine", "memorisation"):
        del results[key]
    for method in (summary.HEADLINE, *summary.COMPARISONS):
        del results["methods"][method]
    text = report.write_report(results, tmp_path).read_text()
    assert "was not measured from test sentences" in text
    for title in ("Gates", "Translator", "Time", "Machine", "Memorisation", "Episodes"):
        assert f"## {title}" not in text


def test_recorded_episodes_are_shown(tmp_path):
    episodes = tmp_path / "figures" / "episodes"
    episodes.mkdir(parents=True)
    (episodes / "left_no_dish.gif").write_bytes(b"GIF89a")
    text = report.write_report(made_up_results(), tmp_path).read_text()
    assert "![left_no_dish](figures/episodes/left_no_dish.gif)" in text
    assert "right_no_dish.gif" not in text


def test_the_terminal_table_shows_methods_and_gates(capsys):
    Console(width=110).print(report.summary_table(made_up_results()))
    shown = capsys.readouterr().out
    assert "Haland, test sentences" in shown
    assert re.search(r"gate: VAE reconstruction, worst policy.*missed", shown)


def test_the_table_by_style_holds_the_oracle_against_the_upper_bound(tmp_path):
    results = made_up_results()
    results["oracle"][STYLES[0]] = [180.0, 192.0]
    text = section(report.write_report(results, tmp_path).read_text(), "By style")
    head, _, first = text.splitlines()[:3]
    assert head.endswith("| upper bound | Oracle / bound |")
    assert first.endswith("| 240 | 0.78 |")  # 186 / 240

    del results["upper_bounds"]
    text = section(report.write_report(results, tmp_path).read_text(), "By style")
    assert "upper bound" not in text
