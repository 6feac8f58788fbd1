"""Recorded results: the numbers of the pages, what is kept of a run, nothing half done."""

import json
import re
import shutil
import sys
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from made_up_results import made_up_results
from PIL import Image
from refused_command import refused

import envs
from experiments import configs, record, results_page
from experiments.compared import PLAYERS
from experiments.errors import UserError
from experiments.overview import overview
from experiments.run_folder import RunFolder

KITCHEN, OTHER = "overcooked/crossway", "overcooked/center_pots"
README = "# Title\n\nbefore\n\n<!-- results -->\n<!-- /results -->\n\nafter\n"


def small_results(**changes):
    """Two styles and two held-out seeds, with numbers that are easy to check.

    Oracle: the seeds' means over styles are 100 and 140, so 120 ± 28.28. Haland's shares are
    0.9, 0.8, 1.0 and 0.5, so 0.8.
    """

    def method(*rows):
        styles = zip(("left", "right"), rows, strict=True)
        return {style: {"returns": list(row)} for style, row in styles}

    return {
        "environment": KITCHEN,
        "preset": "overnight",
        "seed": 0,
        "styles": ["left", "right"],
        "oracle": {"left": [100.0, 200.0], "right": [100.0, 80.0]},
        "methods": {
            "Best response": method((100.0, 180.0), (90.0, 80.0)),
            "Haland, test sentences": method((90.0, 160.0), (100.0, 40.0)),
            "Haland, wrong sentence": method((10.0, 20.0), (10.0, 8.0)),
            "Universal ego": method((50.0, 50.0), (30.0, 30.0)),
            "Universal ego with the style's label": method((60.0, 60.0), (50.0, 50.0)),
        },
        "universal": {"steps": 1_500_000, "best_response_steps": 3_000_000},
        "upper_bounds": {"left": 200.0, "right": 100.0},
        "cross_play": [[110.0, 10.0], [20.0, 90.0]],
        "translator": {"accuracy": 0.875, "by_style": {}},
        "gates": {
            "one": {"value": 1.0, "bar": 0.9, "met": True},
            "two": {"value": 0.1, "bar": 0.9, "met": False},
        },
        "times": {"partners": 1500.0, "evaluation": 300.0},
        "machine": {"processor": "Fast", "cores": 2, "date": "2026-11-22"},
        **changes,
    }


def without(results, *names):
    return {name: value for name, value in results.items() if name not in names}


def rows_of(text: str, heading: str = "environment") -> list[dict[str, str]]:
    """All rows of the Markdown tables whose first column has this heading, by column."""
    found, head = [], None
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line[:1] == "|" else None
        if cells is None:
            head = None
        elif head is None:
            head = cells
        elif head[0] == heading and not set("".join(cells)) <= set("-: "):
            found.append(dict(zip(head, cells, strict=True)))
    return found


def test_the_pages_numbers_are_those_worked_out_by_hand():
    page = results_page.page([overview(small_results())], "")
    measured, worth, how = rows_of(page)
    assert measured == {
        "environment": f"[{KITCHEN}]({KITCHEN}/report.md)",
        "Oracle": "120 ± 28",
        "upper bound": "150",
        "Oracle / bound": "0.82 (0.75)",  # (150/200 + 90/100) / 2
        "ceiling": "0.95",  # (1 + 0.9 + 0.9 + 1) / 4
        "Haland": "98 ± 4",  # 95 and 100
        "Haland / Oracle": "**0.800**",
        "wrong sentence": "0.10",
        "success": "–",
        "translator": "88%",
        "gates met": "1 of 2",
    }
    assert list(worth.values())[1:] == ["100", "15", "40", "55", "98"]
    assert list(how.values())[1:] == [
        *("`overnight`", "0", "2 styles × 2 seeds", "30", "Fast, 2 cores", "2026-11-22")
    ]
    assert "earns 80.0% of the Oracle; it reaches the aim of 95% in 0 of 1 environments" in page


def test_where_games_can_succeed_the_page_says_how_many_do():
    results = small_results()
    haland = results["methods"]["Haland, test sentences"]
    oracle = {style: {"returns": seeds} for style, seeds in results["oracle"].items()}
    for style, (with_haland, with_oracle) in {"left": (0.7, 1.0), "right": (0.9, 0.9)}.items():
        haland[style]["successes"] = [with_haland, with_haland + 0.1]
        oracle[style]["successes"] = [with_oracle, with_oracle]
    results["methods"] = {"Oracle": oracle, **results["methods"]}
    # (0.7 + 0.8 + 0.9 + 1) / 4 and (1 + 1 + 0.9 + 0.9) / 4
    assert rows_of(results_page.page([overview(results)], ""))[0]["success"] == "0.85 (0.95)"


def test_a_view_that_ends_nearby_has_its_row_beside_the_full_one():
    results = small_results()
    told = results["methods"]["Universal ego with the style's label"]
    untold = {"left": {"returns": [25.0, 50.0]}, "right": {"returns": [25.0, 20.0]}}
    methods = {"Universal ego": untold, "Universal ego with the style's label": told}
    results["partner_sight"] = [{"cells": 1, "steps": 100, "methods": methods}]
    full, nearby = rows_of(results_page.page([overview(results)], ""))[2:4]
    # (50/100 + 50/200 + 30/100 + 30/80) / 4 and (60/100 + 60/200 + 50/100 + 50/80) / 4
    assert list(full.values())[1:] == ["everywhere", "0.36", "0.51", "+0.15"]
    assert list(nearby.values())[1:] == ["1 cell away", "0.25", "0.51", "+0.26"]


def test_what_was_not_measured_is_a_dash():
    results = without(small_results(), "upper_bounds", "cross_play", "translator", "machine")
    results["methods"] = {"Best response": results["methods"]["Best response"]}
    measured, worth, how = rows_of(results_page.page([overview(results)], ""))
    dashes = ("upper bound", "Oracle / bound", "Haland", "wrong sentence", "translator")
    assert {measured[name] for name in dashes} == {"–"}
    assert measured["ceiling"] == "0.95"
    assert set(list(worth.values())[1:]) == {"–"}
    assert how["machine"] == how["date"] == "–"


def test_small_returns_keep_their_decimals_and_a_dead_oracle_has_no_share():
    small = small_results(
        oracle={"left": [0.9, 0.8], "right": [1.0, 0.9]}, upper_bounds={"left": 1.0, "right": 1.0}
    )
    assert rows_of(results_page.page([overview(small)], ""))[0]["Oracle"] == "0.90 ± 0.07"
    dead = overview(small_results(oracle={"left": [0.0, 0.0], "right": [0.0, 0.0]}))
    assert dead.share is None
    assert dead.ceiling is None
    json.dumps(dead.oracle_of_bound, allow_nan=False)


def test_the_page_has_the_commands_every_column_and_the_remarks():
    named = [overview(small_results(environment=name)) for name in envs.names(styled_only=True)]
    page = results_page.page(named, "\nA pot is **far**.\n")
    assert "uv run python -m experiments.run --env all --preset overnight\n" in page
    assert "uv run python -m experiments.record runs/*-overnight-0\n" in page
    assert page.endswith("## Remarks\n\nA pot is **far**.\n")
    for name in rows_of(page)[0]:
        assert f"- *{name}*: " in page
    two = [overview(small_results()), overview(small_results(environment=OTHER, seed=3))]
    assert f"--env {OTHER} --preset overnight --seed 3\n" in results_page.page(two, "")
    assert "## Remarks" not in results_page.page(two, "")


def test_the_page_has_the_commands_that_compared_other_methods():
    nothing: dict = {"by_ego": {}}
    compared = {
        "no-vae": nothing,
        "of-ones-own": {"by_ego": {"My method": []}},
        "universal": {**nothing, "seeds": 3},
    }
    rows = [overview(small_results(compared=compared)), overview(small_results(environment=OTHER))]
    page = results_page.page(rows, "")
    run = f"runs/{KITCHEN.replace('/', '-')}-overnight-0"
    command = f"uv run python -m experiments.compare {run} --seeds 3 --methods universal no-vae\n"
    assert command in page
    assert page.count("experiments.compare runs/") == 1
    assert "`python -m experiments.compare RUN --methods --add FILE`: My method.\n" in page
    assert "--add" not in results_page.page(rows[1:], "")


def test_what_was_asked_for_stands_in_the_commands():
    """Methods are grouped by their options; 40 steps are those of all best responses."""
    universal = {"steps": 10, "best_response_steps": 40}
    budget = {"by_ego": {}, "seeds": 1}
    compared = {
        "universal": {**budget, "asked_steps": 10},
        "universal-mlp": {**budget, "asked_steps": 40},
        "fcp": {**budget, "asked_steps": 40},
        "cgan-mlp": {"by_ego": {}},
    }
    results = small_results(compared=compared, universal=universal)
    page = results_page.page([overview(results)], "", options=" --players")
    run = f"runs/{KITCHEN.replace('/', '-')}-overnight-0"
    for said in (
        "--seeds 1 --steps 10 --methods universal cgan-mlp",
        "--seeds 1 --methods universal-mlp fcp",
    ):
        assert f"uv run python -m experiments.compare {run} {said}\n" in page
    assert "experiments.record runs/*-overnight-0 --players\n" in page


def picture(path: Path, size: tuple[int, int] = (60, 40)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    Image.fromarray(noise).save(path)


def finished(path: Path, environment: str = KITCHEN, **changes) -> Path:
    """A run's folder as the pipeline leaves it, with invented results and pictures."""
    results = {**made_up_results(), "environment": environment, **changes}
    with RunFolder.write(path, configs.smoke(environment, 0)) as folder:
        folder.write_json("results.json", results)
        folder.finish_stage("report", {})
    for style in results["styles"]:
        picture(path / "figures" / "episodes" / f"{style}.gif")
        picture(path / "figures" / "episodes" / f"{style}.png")
    return path


@pytest.fixture(autouse=True)
def drawn(monkeypatch):
    """Figures have tests of their own; here a picture stands for them."""

    def draw(results, folder) -> list[Path]:
        file = Path(folder) / "cross_play.png"
        picture(file)
        file.with_suffix(".pdf").write_bytes(b"%PDF")
        return [file] if "cross_play" in results else []

    monkeypatch.setattr(record, "draw_figures", draw)


@pytest.fixture
def readme(tmp_path):
    file = tmp_path / "README.md"
    file.write_text(README)
    return file


def test_a_run_is_recorded_with_pictures_and_links_that_work(tmp_path, readme):
    out = tmp_path / "docs" / "results"
    record.record([finished(tmp_path / "run")], out, readme)
    folder = out / KITCHEN
    files = {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}
    assert files == {
        *("results.json", "report.md", "figures/cross_play.png"),
        *("figures/episodes/left_no_onion.gif", "figures/episodes/right_no_onion.gif"),
    }
    for page in (folder / "report.md", out / "README.md", readme):
        links = re.findall(r"\]\(([^)#:]+)\)", page.read_text())
        assert links, page
        for link in links:
            assert (page.parent / link).is_file(), (page, link)
    with Image.open(folder / "figures" / "cross_play.png") as kept:
        assert kept.size == (60, 40)
        assert kept.mode == "P"
    text = readme.read_text()
    before = "# Title\n\nbefore\n\n<!-- results -->\n\nPreset `quick`: "
    assert text.startswith(f"{before}from sentences it was not trained on")
    assert text.endswith("\n\n<!-- /results -->\n\nafter\n")
    assert "docs/results/overcooked/crossway/report.md" in text


def snapshot(folder: Path) -> dict[str, tuple[bytes, int]]:
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {str(file): (file.read_bytes(), file.stat().st_mtime_ns) for file in files}


def test_recording_again_changes_nothing_and_new_remarks_only_the_page(tmp_path, readme):
    run, out = finished(tmp_path / "run"), tmp_path / "results"
    assert record.record([run], out, readme)
    before = snapshot(tmp_path)
    assert record.record([run], out, readme) == []
    assert record.record([], out, readme) == []
    assert snapshot(tmp_path) == before
    (out / "remarks.md").write_text("The crossway is narrow.\n")
    assert record.record([], out, readme) == [out / "README.md"]
    assert "The crossway is narrow." in (out / "README.md").read_text()


def test_reports_are_made_anew_from_what_is_recorded(tmp_path, readme):
    out = tmp_path / "results"
    record.record([finished(tmp_path / "run")], out, readme)
    text, earlier = out / KITCHEN / "report.md", out / KITCHEN / "figures" / "returns.png"
    made = text.read_text()
    assert made.count("](figures/episodes/") == 2, "as many as are recorded"
    text.write_text("Words of an earlier version.\n")
    picture(earlier)
    assert record.record([], out, readme) == [earlier, text]
    assert text.read_text() == made
    assert not earlier.exists()


def test_a_second_environment_joins_and_a_new_run_replaces_the_old(tmp_path, readme):
    out = tmp_path / "results"
    record.record([finished(tmp_path / "one")], out, readme)
    record.record([finished(tmp_path / "two", OTHER)], out, readme)
    names = [row["environment"] for row in rows_of(readme.read_text())]
    assert [name.partition("]")[0] for name in names] == [f"[{OTHER}", f"[{KITCHEN}"]
    later = finished(tmp_path / "later", seed=5)
    (later / "figures" / "episodes" / "left_no_onion.gif").unlink()
    changed = record.record([later], out, readme)
    assert not (out / KITCHEN / "figures" / "episodes" / "left_no_onion.gif").exists()
    assert out / KITCHEN / "figures" / "episodes" / "left_no_onion.gif" in changed
    assert "left_no_onion.gif" not in (out / KITCHEN / "report.md").read_text()
    assert json.loads((out / KITCHEN / "results.json").read_text())["seed"] == 5


def test_numbers_are_kept_with_the_digits_of_single_precision(tmp_path):
    run = finished(tmp_path / "run", games=3, cross_play=[[1 / 3, 2.0], [12345.678901, 0.0]])
    _, files = record.recorded_files(run)
    kept = json.loads(files[PurePosixPath("results.json")])
    assert kept["cross_play"] == [[0.3333333, 2.0], [12345.68, 0.0]]
    assert kept["games"] == 3
    assert isinstance(kept["games"], int)


def test_records_that_the_readme_does_not_show_leave_it_alone(tmp_path, readme):
    out = tmp_path / "comparisons"
    changed = record.record([finished(tmp_path / "run")], out, None)
    assert out / "README.md" in changed
    assert readme.read_text() == README
    assert f"--out {out.as_posix()} --readme None\n" in (out / "README.md").read_text()


def test_players_of_an_earlier_record_do_not_stay_beside_other_results(tmp_path):
    out = tmp_path / "comparisons"
    record.record([finished(tmp_path / "one")], out, None)
    left = out / KITCHEN / PLAYERS
    left.write_bytes(b"of the earlier run")
    assert left in record.record([finished(tmp_path / "two", seed=1)], out, None)
    assert not left.exists()


def test_where_methods_were_compared_they_are_drawn(tmp_path):
    compared = {"mine": {"by_ego": {"My method": [[1.0]] * 8}}}
    results = made_up_results(others=("My method",))
    run = finished(tmp_path / "run", compared=compared, methods=results["methods"])
    out = tmp_path / "comparisons"
    assert out / "figures" / "figure_3.png" in record.record([run], out, None)
    assert "(figures/figure_3.png)" in (out / "README.md").read_text()
    assert record.record([], out, None) == []
    assert out / "figures" / "figure_3.png" in record.record(
        [finished(tmp_path / "two")], out, None
    )
    assert not any((out / "figures").iterdir()), "where nothing is compared nothing is drawn"


def test_episodes_are_left_out_before_a_record_grows_too_large(tmp_path, monkeypatch):
    run = finished(tmp_path / "run")
    _, files = record.recorded_files(run)
    gif = PurePosixPath("figures/episodes/right_no_onion.gif")
    monkeypatch.setattr(record, "LIMIT_BYTES", sum(map(len, files.values())) - 1)
    _, fewer = record.recorded_files(run)
    assert set(files) - set(fewer) == {gif}
    assert sum(map(len, fewer.values())) <= record.LIMIT_BYTES
    monkeypatch.setattr(record, "LIMIT_BYTES", 1000)
    with pytest.raises(UserError, match="expected at most 1,000"):
        record.recorded_files(run)


def test_no_path_of_the_machine_is_kept(tmp_path, readme):
    run = finished(tmp_path / "run", machine={"processor": "Fast", "home": str(tmp_path)})
    record.record([run], tmp_path / "results", readme)
    for file in (tmp_path / "results").rglob("*.json"):
        assert str(tmp_path) not in file.read_text()
        assert json.loads(file.read_text())["machine"] == {
            "processor": "Fast", "home": tmp_path.name,
        }  # fmt: skip


def test_what_cannot_be_recorded_is_refused_and_nothing_is_written(
    capsys, monkeypatch, tmp_path, readme
):
    monkeypatch.chdir(tmp_path)
    good, unfinished = finished(tmp_path / "good"), finished(tmp_path / "unfinished", OTHER)
    shutil.rmtree(unfinished / "report")
    for arguments, message in (
        ((good, unfinished), "unfinished: its stage 'report' is not done; continue it"),
        ((good, tmp_path / "nowhere"), "nowhere is missing"),
        ((good, good), f"a second run of {KITCHEN}"),
        ((), "nothing is recorded in docs/results"),
        ((good, "--readme", good / "results.json"), "lacks the markers <!-- results -->"),
        ((good, "--readme", "none.md"), "none.md is missing"),
    ):
        line = refused(capsys, monkeypatch, record, *arguments)
        assert message in line, line
        assert not (tmp_path / "docs").exists()
        assert readme.read_text() == README


def test_the_command_says_what_it_wrote(capsys, monkeypatch, tmp_path, readme):
    monkeypatch.chdir(tmp_path)
    finished(tmp_path / "run")
    for expected in ("written: docs/results/README.md", "nothing has changed"):
        monkeypatch.setattr(sys, "argv", ["record", "run"])
        with pytest.raises(SystemExit) as stopped:
            record.main()
        assert not stopped.value.code
        assert expected in capsys.readouterr().out
