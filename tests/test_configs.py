"""The presets, and how they change for an environment."""

import dataclasses

import pytest

import envs
from experiments import configs
from experiments.adaptations import ADAPTATIONS
from experiments.methods.universal import FeedForwardEgos

NAMES = envs.names(styled_only=True)


@pytest.mark.parametrize("preset", configs.PRESETS)
@pytest.mark.parametrize("environment", NAMES)
def test_every_preset_is_a_run_of_every_environment(environment, preset):
    config = configs.PRESETS[preset](environment, 3)
    assert (config.environment, config.preset, config.seed) == (environment, preset, 3)
    known = config.partners
    for training in (known.joint, known.refit, known.oracle, config.universal.training):
        assert training.num_updates > 0
    assert set(ADAPTATIONS) <= set(NAMES)


def test_where_best_responses_start_from_the_universal_ego_it_learns_for_long():
    plain = configs.quick("assistive/jaco", 0)
    assert not plain.partners.universal_start
    kitchen = configs.quick("overcooked/center_pots", 0)
    assert kitchen.partners.universal_start
    assert kitchen.universal.training.total_steps == 40_000_000
    coordination = configs.quick("overcooked/diverse_coordination", 0).partners
    assert coordination.told_start
    assert kitchen.partners.refit == dataclasses.replace(coordination.refit, entropy=0.1)
    assert kitchen.partners.universal_refit.learning_rate < kitchen.partners.refit.learning_rate
    # Where both learn for a short time, neither may know all styles.
    larger = configs.overnight("overcooked/center_pots", 0)
    crossway = configs.quick("overcooked/crossway", 0)
    assert (crossway.partners.told_start, larger.partners.told_start) == (True, False)
    assert not kitchen.partners.told_start
    assert larger.universal == configs.overnight("overcooked/crossway", 0).universal


def test_only_the_egos_that_best_responses_start_from_are_guided():
    kitchen = configs.quick("overcooked/diverse_orders", 0)
    assert kitchen.universal.training.guidance > 0
    compared = FeedForwardEgos()._training(kitchen, 20_000_000)
    assert compared.guidance == 0
    assert compared.entropy == kitchen.universal.training.entropy
