"""Trained models in little space: what is stored comes back, and nothing else is taken for it."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from experiments import devices, export, generate
from experiments.errors import UserError
from experiments.evaluate import measure
from experiments.models import instructions_of, open_model
from haland_jax import (
    bert_weights,
    checkpoint,
    compact,
    networks,
    policy_vae,
    pretrained,
    task_language,
)
from haland_jax.pretrained import BundleError

SHIPPED = pretrained.names()
MEGABYTE = 1_000_000


# --- Compact storage -----------------------------------------------------------------------------


def a_tree(rng) -> dict:
    return {
        "large": {"kernel": rng.normal(size=(200, 300)).astype(np.float32)},
        "middle": rng.normal(size=(40, 50)).astype(np.float32),
        "small": rng.normal(size=7).astype(np.float32),
    }


def test_large_arrays_take_a_byte_a_number_and_are_off_by_half_a_step():
    tree = a_tree(np.random.default_rng(0))
    kernel = tree["large"]["kernel"]
    packed = compact.pack(tree)
    assert packed["large/kernel:codes"].dtype == np.int8
    assert packed["large/kernel:codes"].shape == kernel.shape
    found = compact.unpack(packed)["large"]["kernel"]
    step = np.abs(kernel).max(axis=0) / 127
    np.testing.assert_allclose(packed["large/kernel:step"][0], step, rtol=1e-6)
    assert (np.abs(found - kernel) <= 0.5001 * step).all()
    assert np.abs(found - kernel).max() > 0.4 * step.min(), "nothing was rounded"


def test_other_arrays_are_half_precision_and_small_ones_exact():
    tree = a_tree(np.random.default_rng(1))
    packed = compact.pack(tree)
    assert packed["middle"].dtype == np.float16
    found = compact.unpack(packed)
    assert found["middle"].dtype == np.float32
    np.testing.assert_array_equal(found["middle"], tree["middle"].astype(np.float16))
    np.testing.assert_array_equal(found["small"], tree["small"])


def test_the_policies_of_an_archive_have_steps_of_their_own():
    kernels = np.ones((2, 200, 100), np.float32)
    kernels[1] *= 1000
    packed = compact.pack({"archive": kernels})
    assert packed["archive:step"].shape == (2, 1, 100)
    np.testing.assert_allclose(compact.unpack(packed)["archive"], kernels, rtol=1e-6)


def test_a_column_of_zeros_stays_zero():
    kernel = np.ones((200, 200), np.float32)
    kernel[:, 3] = 0
    np.testing.assert_array_equal(compact.unpack(compact.pack({"k": kernel}))["k"], kernel)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full(5, np.nan, np.float32), "not finite"),
        (np.full(2000, 1e6, np.float32), "too large for half precision"),
        (np.zeros(5), "is float64; expected float32"),
    ],
)
def test_what_cannot_be_stored_is_refused(array, message):
    with pytest.raises(ValueError, match=message):
        compact.pack({"a": array})


# --- Bundles -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def smoke_bundle(smoke_run, tmp_path_factory):
    """The model of the smoke run and its bundle's folder; not to be written to."""
    model = open_model(str(smoke_run))
    folder = tmp_path_factory.mktemp("bundle")
    encoder = bert_weights.load_encoder()
    sizes = pretrained.write(folder, model, encoder, {"encoder": ""})
    return model, folder, sizes


@pytest.fixture
def copied(smoke_bundle, tmp_path):
    """A copy of the bundle that a test may damage."""
    return Path(shutil.copytree(smoke_bundle[1], tmp_path / "copy"))


def test_a_bundle_gives_back_its_model(smoke_bundle):
    model, folder, sizes = smoke_bundle
    found = pretrained.read(folder)
    assert found.env.name == model.env.name
    assert found.env.max_steps == model.env.max_steps
    assert found.event_names == model.event_names
    assert found.haland.style_names == model.haland.style_names
    assert found.haland.architecture == model.haland.architecture
    assert found.haland.diffusion_config == model.haland.diffusion_config
    assert found.haland.translator.config == model.haland.translator.config
    np.testing.assert_array_equal(found.haland.v_hat, model.haland.v_hat)
    np.testing.assert_array_equal(found.event_scale, model.event_scale)
    for name in ("held_out_partners", "oracles", "universal"):
        now, before = getattr(found, name), getattr(model, name)
        assert jax.tree.structure(now) == jax.tree.structure(before)
        for a, b in zip(jax.tree.leaves(now), jax.tree.leaves(before), strict=True):
            # Half a step of the largest magnitude, or half precision.
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=0.51 / 127 * float(np.abs(b).max()))
    sentences = ["I stay on the left.", "No dishes for me."]
    now, before = (m.haland.translate(sentences, drawn=False)[0] for m in (found, model))
    difference = now - before
    assert 0 < float(jnp.abs(difference).max()) < 0.02
    assert sum(sizes.values()) < 12 * MEGABYTE
    assert sum(sizes.values()) == pytest.approx(
        (folder / pretrained.ARRAYS).stat().st_size, rel=0.01
    )


def test_the_translation_that_generates_is_drawn_to_the_styles(smoke_bundle):
    haland, sentence = smoke_bundle[0].haland, "I stay on the left."
    translated, logits = haland.translate([sentence], drawn=False)
    drawn = task_language.drawn_to_styles(translated, haland.v_hat)
    assert float(jnp.abs(drawn - translated).max()) > 0.01
    np.testing.assert_allclose(haland.translate([sentence])[0], drawn, atol=1e-6)
    made = haland.explain(sentence, jax.random.key(0))
    np.testing.assert_allclose(made.v_hat, drawn[0], atol=1e-4)
    np.testing.assert_allclose(made.style_logits, logits[0], atol=1e-4)
    _, latents = haland.generate_from_task_language(drawn, jax.random.key(0)[None])
    np.testing.assert_allclose(made.latent, latents[0], atol=0.01)


def test_generated_policies_act_as_the_models(smoke_bundle):
    model, folder, _ = smoke_bundle
    found = pretrained.read(folder)
    v_hat, keys = model.haland.v_hat[:2], jax.random.split(jax.random.key(0), 2)
    before, _ = model.haland.generate_from_task_language(v_hat, keys)
    after, _ = found.haland.generate_from_task_language(v_hat, keys)
    states = jax.random.uniform(
        jax.random.key(1), (2, 64, model.haland.architecture.observation_dim)
    )
    divergence = networks.kl(
        jax.vmap(networks.act)(before, states), jax.vmap(networks.act)(after, states)
    )
    assert float(divergence.mean()) < 0.01


def test_a_normalised_model_keeps_its_units(smoke_bundle, tmp_path):
    model = smoke_bundle[0]
    size = model.haland.architecture.observation_dim
    statistics = {"mean": jnp.linspace(0.0, 1.0, size), "std": jnp.linspace(0.011, 1.0, size)}
    haland = dataclasses.replace(
        model.haland,
        vae_config=dataclasses.replace(model.haland.vae_config, normalised=True),
        vae_params={**model.haland.vae_params, policy_vae.STATISTICS: statistics},
    )
    normalised = dataclasses.replace(model, haland=haland)
    pretrained.write(tmp_path, normalised, bert_weights.load_encoder(), {"encoder": ""})
    found = pretrained.read(tmp_path)
    v_hat, keys = model.haland.v_hat[:2], jax.random.split(jax.random.key(0), 2)
    before, _ = haland.generate_from_task_language(v_hat, keys)
    after, _ = found.haland.generate_from_task_language(v_hat, keys)
    states = statistics["mean"] + statistics["std"] * jax.random.normal(
        jax.random.key(1), (2, 64, size)
    )
    divergence = networks.kl(
        jax.vmap(networks.act)(before, states), jax.vmap(networks.act)(after, states)
    )
    assert float(divergence.mean()) < 0.01
    # Weights of such players may differ a hundredfold, which 8 bits a column would not keep.
    for name in ("held_out_partners", "oracles", "universal"):
        for a, b in zip(
            jax.tree.leaves(getattr(found, name)),
            jax.tree.leaves(getattr(model, name)),
            strict=True,
        ):
            np.testing.assert_array_equal(a, b)


def test_only_what_fine_tuning_changed_is_stored_of_the_encoder(smoke_bundle):
    model, folder, _ = smoke_bundle
    config = model.haland.translator.config
    layers = model.haland.translator.architecture.layers
    changed = {f"layer_{i}" for i in range(layers - config.trainable_layers, layers)}
    packed = pretrained.safetensors.numpy.load_file(folder / pretrained.ARRAYS)
    assert {n.split("/")[1] for n in packed if n.startswith("encoder/")} == changed


def test_one_flipped_byte_is_found(copied):
    content = bytearray((copied / pretrained.ARRAYS).read_bytes())
    content[len(content) // 2] ^= 1
    (copied / pretrained.ARRAYS).write_bytes(content)
    with pytest.raises(BundleError, match=r"damaged: arrays\.safetensors is not what was written"):
        pretrained.read(copied)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "has the format 2, this version reads 1"),
        ({"encoder_fingerprint": "0" * 64}, "fine-tuned from another encoder than the packaged"),
        ({"styles": ["left"]}, "another version of .*: its styles were"),
        ({"environment": "overcooked/gone"}, "does not fit this version .*unknown environment"),
        ({"environment": "overcooked/crossway"}, "another version of overcooked/crossway"),
        ({"vae": {"latent_dim": 64}}, "does not fit this version"),
    ],
)
def test_a_bundle_that_does_not_belong_here_is_refused(copied, change, message):
    file = copied / pretrained.CONFIGURATION
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(BundleError, match=message):
        pretrained.read(copied)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (pretrained.CONFIGURATION, None, "there is no bundle at"),
        (pretrained.CONFIGURATION, "{", "config.json is not what was written"),
        (pretrained.ARRAYS, None, "arrays.safetensors is missing"),
    ],
)
def test_a_missing_or_broken_file_is_named(copied, name, content, message):
    (copied / name).unlink()
    if content is not None:
        (copied / name).write_text(content)
    with pytest.raises(BundleError, match=message):
        pretrained.read(copied)


def test_errors_of_bundles_are_one_line_for_commands():
    assert issubclass(BundleError, checkpoint.CheckpointError)


def test_the_fingerprint_is_of_the_parameters():
    encoder = bert_weights.load_encoder()
    before = pretrained.fingerprint(encoder)
    assert before == pretrained.fingerprint(bert_weights.load_encoder())
    params = dict(encoder.params["params"])
    params["pooler"] = jax.tree.map(lambda leaf: leaf.at[0].add(1e-6), params["pooler"])
    assert pretrained.fingerprint(encoder.replace(params={"params": params})) != before


def test_an_unknown_pretrained_model_lists_those_there_are():
    with pytest.raises(UserError, match=r"unknown pretrained model .*diverse_coordination"):
        open_model("pretrained:overcooked/nowhere")
    with pytest.raises(UserError, match="package's model is pretrained:assistive/jaco"):
        open_model("assistive/jaco")
    with pytest.raises(ValueError, match=r"no pretrained model .*diverse_coordination.*or train"):
        pretrained.load("overcooked/nowhere")


# --- The command ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_export_writes_a_bundle_with_its_card(smoke_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    out = tmp_path / "bundle"
    arguments = ["export", str(smoke_run), "--out", str(out), "--games", "2"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--limit", "1"])
    with pytest.raises(SystemExit) as stopped:
        export.main()
    assert stopped.value.code == 2
    assert "more than 1 MB" in capsys.readouterr().err
    assert not out.exists(), "a bundle that is too large is not put anywhere"
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as stopped:
        export.main()
    assert not stopped.value.code
    assert {file.name for file in out.iterdir()} == {"config.json", "arrays.safetensors", "card.md"}
    card = (out / "card.md").read_text()
    assert "KL of generated policies" in card
    assert "Haland, test sentences" in card
    assert str(tmp_path) not in card + (out / "config.json").read_text()


def test_generate_works_without_a_run(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(devices, "prepare", lambda **_: None)
    gif = tmp_path / "out.gif"
    monkeypatch.setattr(sys, "argv", ["generate", "I cook on the left.", "--gif", str(gif)])
    with pytest.raises(SystemExit) as stopped:
        generate.main()
    assert not stopped.value.code
    assert "held-out, style left" in capsys.readouterr().out.replace("\n", " ")
    with Image.open(gif) as episode:
        assert episode.n_frames > 100


# --- What is shipped -----------------------------------------------------------------------------


def test_the_default_model_is_shipped():
    assert "overcooked/diverse_coordination" in SHIPPED


@pytest.mark.parametrize("environment", SHIPPED)
def test_shipped_bundles_are_small_and_say_what_was_lost(environment):
    folder = pretrained.FOLDER / environment
    assert sum(file.stat().st_size for file in folder.iterdir()) <= 12 * MEGABYTE
    assert "## What was lost" in (folder / "card.md").read_text()
    stored = json.loads((folder / pretrained.CONFIGURATION).read_text())
    assert stored["environment"] == environment


@pytest.mark.slow
@pytest.mark.parametrize("environment", SHIPPED)
def test_shipped_models_earn_most_of_the_oracles_return(environment):
    model = pretrained.load(environment)
    sentences = {name: [found.test[0]] for name, found in instructions_of(model).items()}
    found = measure(model, sentences, games=2, seed=0)["mean"]
    assert found["share_of_oracle"] > 0.7, found
    assert found["accuracy"] > 0.7, found
    if model.env.success_event is not None:
        assert found["success"] > 0.7, found
