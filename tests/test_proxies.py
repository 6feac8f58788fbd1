"""Human proxies: cloned from rounds that scripted players played, and good partners like them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.base import Pair
from experiments import evaluate, proxies
from experiments.errors import UserError
from experiments.models import instructions_of, open_model
from experiments.study import arena as arenas
from experiments.study import export, recording
from experiments.study.rounds import read_rounds
from experiments.study.store import Begun, Store
from experiments.study.tables import FINISHED
from haland_jax import networks
from haland_jax.behaviour_cloning import CloningConfig
from haland_jax.fit import FitConfig

MODEL = "pretrained:lbf/spread"
STYLES, ROUNDS = ("level_2", "level_7"), 80
CONFIG = CloningConfig(FitConfig(learning_rate=3e-3, steps=1500, warmup_steps=20))


@pytest.fixture(scope="module")
def model():
    return open_model(MODEL)


@pytest.fixture(scope="module")
def study(model, tmp_path_factory):
    """The folder of a study in which trained partners stood in for people."""
    env, folder = model.env, tmp_path_factory.mktemp("study")
    store = Store(f"sqlite:///{folder / 'study.db'}")
    participant, _ = store.enrol(lambda _: [])

    @jax.jit
    def play(key, style, ego, person):
        state, timestep = arenas._start(env, key, style)

        def step(carry, index):
            state, timestep, over = carry
            act_key, env_key = arenas._step_keys(key, index)
            keys = Pair(*jax.random.split(act_key))
            actions = Pair(
                *(
                    networks.sample(k, networks.act(policy, seen))
                    for k, policy, seen in zip(
                        keys, (ego, person), timestep.observation, strict=True
                    )
                )
            )
            state, timestep = env.step(env_key, state, actions, style)
            return (state, timestep, over | timestep.done), (actions, timestep.reward, over)

        start = (state, timestep, jnp.zeros((), bool))
        return jax.lax.scan(step, start, jnp.arange(env.max_steps))[1]

    number = 0
    for name in STYLES:
        index = env.style_names.index(name)
        ego, person = (
            jax.tree.map(lambda leaf, i=index: leaf[i, 0], policies)
            for policies in (model.oracles, model.held_out_partners)
        )
        for _ in range(ROUNDS):
            actions, rewards, over = play(jax.random.key(number), env.style(name), ego, person)
            length = int((~over).sum())
            rows = zip(*actions, rewards, np.zeros(env.max_steps), strict=True)
            steps = [(int(a), int(b), float(r), 0.0) for a, b, r, _ in rows][:length]
            begun = Begun(
                number, "oracle", env.name, MODEL, "f", name, "said", name, 0, number, b"", 6.0
            )
            one = store.begin_round(participant.id, begun)
            store.add_steps([(one, 0, recording.pack(steps))])
            store.end_round(one, FINISHED)
            number += 1
    store.close()
    return folder


@pytest.fixture(scope="module")
def cloned(study):
    rounds = read_rounds(str(study))
    assert len(rounds) == 2 * ROUNDS
    return proxies.make_proxies(rounds, None, 2, CONFIG, jax.random.key(0))


@pytest.mark.slow
def test_proxies_play_as_the_players_did(model, cloned, tmp_path):
    assert cloned.styles == STYLES
    for found in cloned.measured.values():
        assert found["rounds"] == ROUNDS
        assert found["accuracy"] > max(0.7, found["commonest"] + 0.1)
    proxies.save(tmp_path / "proxies", cloned)
    again = proxies.load(tmp_path / "proxies")
    jax.tree.map(np.testing.assert_array_equal, again.policies, cloned.policies)
    assert again._replace(policies=None) == cloned._replace(policies=None)
    assert proxies.table_of(again).row_count == 2

    sentences = {name: list(one.test) for name, one in instructions_of(model).items()}
    changed, spoken = evaluate.with_proxies(model, sentences, tmp_path / "proxies")
    assert tuple(spoken) == STYLES
    played = evaluate.measure(changed, spoken, games=16, seed=0)
    best = np.mean([found["oracle"] for found in played["styles"].values()])
    assert best > 0.6, "an agent that knows the style works with its proxies"
    assert played["mean"]["return"] > 0.6, "so does the one that is made from a sentence"
    swapped = {"level_2": spoken["level_7"], "level_7": spoken["level_2"]}
    wrong = evaluate.measure(changed, swapped, games=16, seed=0)
    assert wrong["mean"]["return"] < 0.2, "and the style is in the proxies"


def test_an_exported_file_gives_the_same_rounds(study, tmp_path):
    store = Store(f"sqlite:///{study / 'study.db'}")
    file = tmp_path / "rounds.jsonl"
    file.write_text("".join(export.rounds_jsonl(store)))
    store.close()
    for one, other in zip(read_rounds(str(file)), read_rounds(str(study)), strict=True):
        assert one[:6] == other[:6]
        np.testing.assert_array_equal(np.array(one.actions), np.array(other.actions))
        np.testing.assert_array_equal(one.rewards, other.rewards)


def test_what_cannot_be_cloned_is_refused(study, cloned, model, tmp_path):
    with pytest.raises(UserError, match=r"study\.db is missing; name a study's folder"):
        read_rounds(str(tmp_path))
    empty = tmp_path / "empty.jsonl"
    empty.write_text("")
    with pytest.raises(UserError, match="holds no finished rounds"):
        read_rounds(str(empty))
    empty.write_text("{}\n")
    with pytest.raises(UserError, match=r"is no rounds\.jsonl of a study"):
        read_rounds(str(empty))
    rounds = read_rounds(str(study))
    with pytest.raises(UserError, match="there are rounds of lbf/spread; name one with --env"):
        proxies.make_proxies(rounds, "overcooked/crossway", 1, CONFIG, jax.random.key(0))
    other = rounds[0]._replace(environment="a")
    with pytest.raises(UserError, match="there are rounds of a, lbf/spread; name one"):
        proxies.make_proxies([*rounds, other], None, 1, CONFIG, jax.random.key(0))
    changed = rounds[0]._replace(rewards=rounds[0].rewards + 1)
    with pytest.raises(UserError, match="earns something else when it is played again"):
        proxies.make_proxies([changed], None, 1, CONFIG, jax.random.key(0))
    with pytest.raises(UserError, match="holds no proxies"):
        proxies.load(tmp_path / "nothing")
    proxies.save(tmp_path / "proxies", cloned)
    with pytest.raises(UserError, match="none of level_1"):
        evaluate.with_proxies(model, {"level_1": ["One."]}, tmp_path / "proxies")
    proxies.save(tmp_path / "proxies", cloned._replace(environment="overcooked/crossway"))
    with pytest.raises(UserError, match="has proxies of overcooked/crossway, the model is of lbf"):
        evaluate.with_proxies(model, {"level_2": ["Two."]}, tmp_path / "proxies")
