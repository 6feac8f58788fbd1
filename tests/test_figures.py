"""The figures show the numbers of results.json, and drawing leaves no trace in matplotlib."""

import itertools

import matplotlib
import numpy as np
import pytest
from made_up_results import SHARES, STYLES, UNIVERSAL_SHARES, made_up_results
from matplotlib._pylab_helpers import Gcf
from PIL import Image

from experiments import summary
from experiments.errors import UserError
from experiments.figures import of_run as figures


def two_styles() -> dict:
    """Two styles with two held-out seeds, small enough to do by hand."""
    return {
        "styles": ["left", "right"],
        "oracle": {"left": [100.0, 200.0], "right": [50.0, 0.0]},
        "methods": {
            "Own idea": {"left": {"returns": [1.0, 1.0]}, "right": {"returns": [1.0, 1.0]}},
            "Best response": {
                "left": {"returns": [[80.0, 100.0], [160.0, 160.0]]},
                "right": {"returns": [[20.0, 30.0], [5.0, 7.0]]},
            },
        },
    }


def test_the_summary_by_hand():
    oracle, best, own = summary.summarise(two_styles())
    assert (oracle.method, best.method, own.method) == ("Oracle", "Best response", "Own idea")
    # Seeds, averaged over styles: (90 + 25) / 2 and (160 + 6) / 2.
    assert best.mean == pytest.approx((57.5 + 83.0) / 2)
    assert best.std == pytest.approx(25.5 / np.sqrt(2))
    # Ratios 0.9, 0.8 and 0.5; the partner whose Oracle is 0 has none.
    assert best.ratio == pytest.approx(2.2 / 3)
    assert best.ratio_std == pytest.approx(0.1 / np.sqrt(2))
    assert summary.dead_partners(two_styles()) == 1
    assert (best.episodes, own.episodes, oracle.episodes) == (8, None, None)


def test_results_that_contradict_themselves_are_refused():
    results = two_styles()
    del results["methods"]["Best response"]["right"]
    with pytest.raises(UserError, match="'Best response' for the style 'right'"):
        summary.summarise(results)
    results = two_styles()
    results["methods"]["Own idea"]["left"]["returns"] = [1.0]
    with pytest.raises(UserError, match="'Own idea' differ in their number of seeds"):
        summary.summarise(results)


def test_every_figure_is_drawn_and_none_knows_of_pyplot(tmp_path):
    before = dict(matplotlib.rcParams)
    drawn = figures.draw_figures(made_up_results(others=("General",)), tmp_path)
    assert [file.stem for file in drawn] == list(figures.FIGURES)
    assert dict(matplotlib.rcParams) == before
    assert Gcf.get_all_fig_managers() == []
    for file in drawn:
        with Image.open(file) as image:
            grey = np.asarray(image.convert("L"))
            assert round(image.info["dpi"][0]) == 150
        assert min(grey.shape) > 300
        assert grey.std() > 10, f"{file.name} is nearly blank"
        assert file.with_suffix(".pdf").read_bytes().startswith(b"%PDF")


def test_only_what_was_measured_is_drawn(tmp_path):
    results = made_up_results()
    for key in ("curves", "task_language", "cross_play"):
        del results[key]
    drawn = figures.draw_figures(results, tmp_path)
    assert [file.stem for file in drawn] == [
        "share_of_oracle",
        "returns_by_style",
        "comparisons_by_style",
    ]
    for method in UNIVERSAL_SHARES:
        del results["methods"][method]
    drawn = figures.draw_figures(results, tmp_path)
    assert [file.stem for file in drawn] == ["share_of_oracle", "returns_by_style"]


def test_a_run_that_learnt_nothing_is_still_drawn(tmp_path):
    results = made_up_results()
    results["oracle"] = {style: [0.0] for style in STYLES}
    for method in results["methods"].values():
        for style in STYLES:
            method[style]["returns"] = [[0.0]]
    results["cross_play"] = np.zeros((8, 8)).tolist()
    del results["curves"], results["task_language"]
    assert len(figures.draw_figures(results, tmp_path)) == 4
    cells = figures.cross_play(results).axes[0].texts
    assert {cell.get_text() for cell in cells} == {"0\n–"}


def test_the_bars_are_as_tall_as_the_returns():
    results = made_up_results()
    axes = figures.returns_by_style(results).axes[0]
    bars = [[patch.get_height() for patch in group.patches] for group in axes.containers]
    labels = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert labels == ["Oracle", *SHARES]
    for method, heights in zip(labels, bars, strict=True):
        np.testing.assert_allclose(heights, summary.returns(results, method).mean(axis=1))


def test_the_labels_of_the_heatmaps_do_not_overlap():
    results = made_up_results()
    for figure in (figures.task_language(results), figures.cross_play(results)):
        figure.canvas.draw()
        for axes in figure.axes[:-1]:
            boxes = [label.get_window_extent() for label in axes.get_yticklabels()]
            assert all(not a.overlaps(b) for a, b in itertools.pairwise(boxes))


def test_cross_play_is_shown_as_return_and_as_share_of_the_partners_oracle():
    results = made_up_results()
    axes = figures.cross_play(results).axes[0]
    cells = [text.get_text().split("\n") for text in axes.texts]
    values = np.asarray(results["cross_play"])
    oracle = np.array([np.mean(results["oracle"][style]) for style in STYLES])
    np.testing.assert_allclose([float(v) for v, _ in cells], values.ravel(), atol=0.5)
    # Columns are partners: each is divided by its own style's Oracle.
    shares = np.array([float(share.rstrip("%")) / 100 for _, share in cells]).reshape(8, 8)
    np.testing.assert_allclose(shares, values / oracle[None, :], atol=0.006)
    np.testing.assert_allclose(axes.images[0].get_array(), values / oracle[None, :])
    assert [text.get_fontweight() == "bold" for text in axes.texts] == list(np.eye(8).ravel() == 1)


def test_the_comparisons_stand_beside_the_oracle_and_haland():
    labels = [
        text.get_text()
        for text in figures.comparisons_by_style(made_up_results(("General",)))  # pyright: ignore
        .legends[0]
        .get_texts()
    ]
    assert labels == ["Oracle", "Haland, test sentences", *UNIVERSAL_SHARES, "General"]


def test_universal_egos_and_other_methods_have_a_panel_each():
    results = made_up_results(("General",))
    figure = figures.comparisons_by_style(results)
    assert figure is not None
    egos, others = figure.axes
    assert len(egos.containers) == 2 + len(UNIVERSAL_SHARES)
    assert len(others.containers) == 2 + 1
    shown = ("Oracle", summary.HEADLINE, "General")
    dots = np.concatenate([np.asarray(line.get_ydata()) for line in others.lines[: len(shown)]])
    expected = [summary.returns(results, name).ravel() for name in shown]
    np.testing.assert_allclose(dots, np.concatenate(expected))


def test_a_heatmap_cell_holds_its_own_event_and_style():
    results = made_up_results()
    events = results["task_language"]["events"]
    ego, partner = figures.task_language(results).axes[:2]
    assert ego.get_title() == "events of the ego"
    row, column = 5, 3
    name = partner.get_yticklabels()[row].get_text()
    event = events.index(f"partner:{name.replace(' @ ', '@').replace(' ', '_')}")
    expected = results["task_language"]["v_hat"][column][event]
    assert partner.images[0].get_array()[row, column] == pytest.approx(expected)
