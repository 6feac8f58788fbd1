"""The report says what results.json says, the bad news included."""

import re

import pytest
from made_up_results import STYLES, made_up_results
from rich.console import Console

from experiments import report, summary


@pytest.fixture(autouse=True)
def no_drawing(monkeypatch):
    """The figures have their own test; here only their names matter."""

    def name_only(results, folder):
        folder.mkdir(exist_ok=True)
        return [folder / "returns_by_style.png"]

    monkeypatch.setattr(report, "draw_figures", name_only)


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


@pytest.mark.parametrize(
    ("share", "wrong", "expected"),
    [
        (0.97, 0.3, ("97% of the Oracle", "reaches the aim", "the sentence matters")),
        (0.80, 0.78, ("80% of the Oracle", "misses the aim", "hardly matters")),
    ],
)
def test_the_verdict_follows_the_numbers(tmp_path, share, wrong, expected):
    results = made_up_results()
    for method, factor in ((summary.HEADLINE, share), (summary.WRONG, wrong)):
        for style in STYLES:
            results["methods"][method][style]["returns"] = [
                [factor * value] for value in results["oracle"][style]
            ]
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
    del results["methods"][summary.HEADLINE]
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
