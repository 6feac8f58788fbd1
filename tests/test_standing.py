"""Haland beside other methods: verdicts and budgets by hand."""

import numpy as np
import pytest
from made_up_results import made_up_results

from experiments import report, results_page, standing
from experiments.figures.style import FILLS
from experiments.intervals import Estimate
from experiments.methods import ablations, fine_tuning, self_play, universal
from experiments.overview import overview
from experiments.summary import HEADLINE, UNIVERSAL, UNIVERSAL_WITH_LABEL
from haland_jax import recurrent_egos

pytestmark = pytest.mark.usefixtures("no_drawing")


def measured(**shares: float) -> dict:
    """Two styles, three held-out seeds, Oracles of 10; every partner pays the method's share."""
    styles = ["one", "two"]
    methods = {
        name.replace("_", " "): {style: {"returns": [10 * share] * 3} for style in styles}
        for name, share in shares.items()
    }
    return {"styles": styles, "oracle": {style: [10.0] * 3 for style in styles}, "methods": methods}


def test_the_lead_with_the_same_partners_decides_who_is_ahead():
    def verdict(low: float, high: float) -> str:
        share, lead = Estimate(0.9, 0.8, 1.0), Estimate((low + high) / 2, low, high)
        one = standing.Standing("other", share, share, lead, 0.9, 0.8, None, None)
        assert not one.apart
        return one.verdict

    assert verdict(0.01, 0.03) == "ahead"
    assert verdict(-0.01, 0.03) == "level"
    assert verdict(0.0, 0.03) == "level"
    assert verdict(-0.03, -0.01) == "behind"


def test_a_lead_is_taken_partner_by_partner():
    """Partners differ by far more than the two methods, of which one is ahead with each."""
    results = measured(Other=0.5)
    levels = {"one": [2.0, 5.0, 8.0], "two": [1.0, 4.0, 9.0]}
    results["methods"]["Other"] = {name: {"returns": row} for name, row in levels.items()}
    results["methods"][HEADLINE] = {
        name: {"returns": [value + more for value, more in zip(row, (0.4, 0.5, 0.6), strict=True)]}
        for name, row in levels.items()
    }
    (found,) = standing.standings(results)
    assert found.lead.value == pytest.approx(0.05)
    assert 0.03 < found.lead.low < found.lead.high < 0.07
    assert found.verdict == "ahead"
    assert not found.apart
    assert found.mean == pytest.approx(29 / 60)
    assert found.lowest == pytest.approx(14 / 30)


def test_steps_are_held_against_those_of_all_best_responses():
    results = measured(General_Ego=0.5, Universal_ego=0.9, My_method=0.2, Without_VAE=0.1)
    results["methods"][HEADLINE] = results["methods"]["General Ego"]
    results["universal"] = {"steps": 10, "best_response_steps": 40}
    results["compared"] = {"universal": {"by_ego": {"General Ego": []}, "steps": 20}}
    found = {one.method: one for one in standing.standings(results)}
    assert list(found) == ["General Ego", UNIVERSAL, "My method", "Without VAE"]
    assert (found["General Ego"].steps, found["General Ego"].budget) == (20, 0.5)
    assert (found[UNIVERSAL].steps, found[UNIVERSAL].budget) == (10, 0.25)
    assert (found["Without VAE"].steps, found["Without VAE"].budget) == (None, None)
    assert found["Without VAE"].share == pytest.approx((0.1, 0.1, 0.1))
    assert found["Without VAE"].verdict == "ahead"
    assert found["Without VAE"].apart
    best = standing.best_ego(standing.standings(results))
    assert best is not None
    assert best.method == UNIVERSAL, "ablations and others are no universal egos"
    assert best.verdict == "behind"


def test_of_egos_of_the_same_kind_those_that_learnt_longest_count():
    shorter, longer = (UNIVERSAL, UNIVERSAL_WITH_LABEL), standing.WITHOUT_MEMORY

    def run(steps, *methods):
        trained = {"by_ego": dict.fromkeys(longer), "steps": steps}
        return {
            "methods": dict.fromkeys((HEADLINE, "FCP", *shorter, *methods)),
            "oracle": {},
            "universal": {"steps": 100, "best_response_steps": 400},
            "compared": {"universal-mlp": trained},
        }

    assert standing.universal_egos(run(400, *longer)) == [*longer, "FCP"]
    assert standing.universal_egos(run(50, *longer)) == [*longer, "FCP", *shorter]
    assert standing.universal_egos(run(400)) == ["FCP", *shorter]
    assert standing.without_memory(run(400, *longer)) == (*longer, 400)
    assert standing.without_memory(run(50, *longer)) == (*shorter, 100)
    assert standing.without_memory(run(400)) == (*shorter, 100)
    assert standing.without_memory({"methods": {HEADLINE: {}}}) is None
    both = standing.compared([run(400, *longer), run(400)])
    assert both == [HEADLINE, *longer, "FCP", *shorter], "the second run has nothing longer"


def test_tables_and_figures_know_all_methods_by_name():
    egos = {*recurrent_egos.VARIANTS, universal.GENERAL_MLP, universal.INSTRUCTED_MLP}
    egos |= {self_play.SELF_PLAY, self_play.FCP, UNIVERSAL, UNIVERSAL_WITH_LABEL}
    parts = {ablations.CGAN_MLP, ablations.CGAN_UNET, ablations.NO_TRANSLATOR, ablations.NO_VAE}
    assert set(standing.EGOS) == egos
    assert set(standing.ABLATIONS) == parts
    further = {ablations.NO_VAE_CLEAN, fine_tuning.NO_FINE_TUNING}
    assert set(standing.FURTHER_ABLATIONS) == further
    assert set(FILLS) >= egos | parts | further


def test_nothing_to_compare():
    assert standing.standings(measured(General_Ego=0.5)) == []
    alone = measured()
    alone["methods"][HEADLINE] = {style: {"returns": [9.0]} for style in alone["styles"]}
    alone["oracle"] = {style: [10.0] for style in alone["styles"]}
    assert standing.standings(alone) == []
    assert standing.best_ego(standing.standings(alone)) is None


def test_report_and_page_name_the_best_universal_ego(tmp_path):
    results = made_up_results(others=("General Ego", "Without VAE"))
    results["universal"] = {"steps": 10_000_000, "best_response_steps": 40_000_000}
    assert "## Beside other methods" not in report.write_report(results, tmp_path).read_text()
    results["compared"] = {"universal": {"by_ego": {"General Ego": []}, "steps": 20_000_000}}
    text = report.write_report(results, tmp_path).read_text()
    section = text.split("## Beside other methods")[1].split("\n## ")[0]
    assert "| General Ego |" in section
    assert "| 20 M | 50% |" in section
    row = overview(results)
    assert next(iter(row.shares)) == HEADLINE
    page = results_page.page([row], "")
    assert (
        "Haland is ahead of Universal ego with the style's label (10 M steps, 25% of those of all "
        f"best responses): {row.means[HEADLINE][0]:.2f} and 0.78 of the Oracle in the mean" in page
    )
    assert "The intervals of the interquartile means are apart." in page
    assert np.isclose(row.shares[HEADLINE].value, 0.92, atol=0.03)
    assert "| General Ego | 20 M (50%) |" in page
    assert f"| {UNIVERSAL} | 10 M (25%) |" in page
    assert "beside the best universal ego of each environment" in page
