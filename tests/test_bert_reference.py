"""Our BERT equals the reference implementation, and bad checkpoints are refused."""

import json
import os
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from haland_jax.bert import Bert, BertArchitecture, mean_pooled
from haland_jax.bert_weights import (
    EncoderWeightsError,
    checkpoint_folder,
    load_architecture,
    load_encoder,
    load_tokenizer,
    tokenize,
)

pytestmark = pytest.mark.full_compilation

GOLDEN = Path(os.environ.get("GOLDEN_DIR", Path(__file__).parent / "golden")) / "bert"
TOLERANCE = 1e-4
WIDTH, LAYERS, INTERMEDIATE, VOCABULARY = 8, 2, 12, 20
CONFIG = {
    "model_type": "bert",
    "vocab_size": VOCABULARY,
    "hidden_size": WIDTH,
    "num_hidden_layers": LAYERS,
    "num_attention_heads": 2,
    "intermediate_size": INTERMEDIATE,
    "max_position_embeddings": 16,
    "type_vocab_size": 2,
    "hidden_act": "gelu",
    "layer_norm_eps": 1e-12,
}


def small_tensors() -> dict[str, np.ndarray]:
    """Random tensors under the names and in the shapes of a BERT checkpoint."""
    random = np.random.default_rng(0)
    shapes = {
        "embeddings.word_embeddings.weight": (VOCABULARY, WIDTH),
        "embeddings.position_embeddings.weight": (16, WIDTH),
        "embeddings.token_type_embeddings.weight": (2, WIDTH),
        "pooler.dense.weight": (WIDTH, WIDTH),
        "pooler.dense.bias": (WIDTH,),
    }
    norms = ["embeddings.LayerNorm"]
    for index in range(LAYERS):
        layer = f"encoder.layer.{index}"
        for name, inputs, outputs in (
            ("attention.self.query", WIDTH, WIDTH),
            ("attention.self.key", WIDTH, WIDTH),
            ("attention.self.value", WIDTH, WIDTH),
            ("attention.output.dense", WIDTH, WIDTH),
            ("intermediate.dense", WIDTH, INTERMEDIATE),
            ("output.dense", INTERMEDIATE, WIDTH),
        ):
            shapes[f"{layer}.{name}.weight"] = (outputs, inputs)
            shapes[f"{layer}.{name}.bias"] = (outputs,)
        norms += [f"{layer}.attention.output.LayerNorm", f"{layer}.output.LayerNorm"]
    for norm in norms:
        shapes[f"{norm}.weight"] = shapes[f"{norm}.bias"] = (WIDTH,)
    return {name: random.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def save_checkpoint(folder: Path, tensors: dict[str, np.ndarray], config=None) -> str:
    (folder / "config.json").write_text(json.dumps(CONFIG if config is None else config))
    save_file(tensors, folder / "model.safetensors")
    return str(folder)


@pytest.fixture(scope="module")
def packaged():
    return load_encoder()


@pytest.fixture(autouse=True)
def _full_precision():
    with jax.default_matmul_precision("float32"):
        yield


def recordings() -> list[Path]:
    return sorted(GOLDEN.glob("*.npz"))


def test_there_are_recordings():
    assert recordings(), f"no recordings in {GOLDEN}"


@pytest.mark.parametrize("path", recordings(), ids=lambda path: path.stem)
def test_outputs_equal_the_reference(packaged, path):
    recorded = np.load(path)
    mask = recorded["attention_mask"].astype(bool)
    output = Bert(packaged.architecture).apply(packaged.params, recorded["input_ids"], mask)
    np.testing.assert_allclose(
        output.hidden[mask], recorded["last_hidden_state"][mask], rtol=0, atol=TOLERANCE
    )
    np.testing.assert_allclose(output.pooled, recorded["pooler_output"], rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(
        mean_pooled(output.hidden, mask), recorded["mean_pooled"], rtol=0, atol=TOLERANCE
    )


@pytest.mark.parametrize("path", recordings(), ids=lambda path: path.stem)
def test_token_ids_equal_the_reference(path):
    recorded = np.load(path)
    # The recording cuts sentences that fill all 32 places; we refuse longer ones instead.
    whole = recorded["attention_mask"].sum(-1) < 32
    assert whole.any()
    sentences = [str(sentence) for sentence in recorded["sentences"][whole]]
    token_ids, mask = tokenize(load_tokenizer(), sentences, maximum_length=32)
    np.testing.assert_array_equal(token_ids, recorded["input_ids"][whole])
    np.testing.assert_array_equal(mask, recorded["attention_mask"][whole].astype(bool))


def test_padding_does_not_change_the_output(packaged):
    token_ids, mask = tokenize(load_tokenizer(), ["Keep to the left half; no onions for me."])
    length = int(mask.sum())
    apply = Bert(packaged.architecture).apply
    short = apply(packaged.params, token_ids[:, :length], mask[:, :length])
    garbage = jnp.where(mask, token_ids, 1234)
    padded = apply(packaged.params, garbage, mask)
    np.testing.assert_allclose(padded.hidden[:, :length], short.hidden, rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        mean_pooled(padded.hidden, mask),
        mean_pooled(short.hidden, mask[:, :length]),
        rtol=0,
        atol=1e-5,
    )


def test_dropout_acts_only_when_asked_for(packaged):
    token_ids, mask = tokenize(load_tokenizer(), ["Stay left."])
    bert = Bert(packaged.architecture, dropout=0.5)
    rngs = {"dropout": jax.random.key(0)}
    plain = Bert(packaged.architecture).apply(packaged.params, token_ids, mask)
    same = bert.apply(packaged.params, token_ids, mask)
    other = bert.apply(packaged.params, token_ids, mask, deterministic=False, rngs=rngs)
    np.testing.assert_array_equal(same.hidden, plain.hidden)
    assert float(jnp.abs(other.hidden - plain.hidden).max()) > 0.01


def test_a_saved_checkpoint_loads_tensor_by_tensor(tmp_path):
    tensors = small_tensors()
    encoder = load_encoder(save_checkpoint(tmp_path, tensors))
    assert encoder.architecture == BertArchitecture(
        vocabulary=VOCABULARY,
        width=WIDTH,
        layers=LAYERS,
        heads=2,
        intermediate_width=INTERMEDIATE,
        positions=16,
    )
    params = encoder.params["params"]
    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    assert count == sum(tensor.size for tensor in tensors.values())
    np.testing.assert_array_equal(
        params["layer_1"]["intermediate"]["kernel"],
        tensors["encoder.layer.1.intermediate.dense.weight"].T,
    )
    np.testing.assert_array_equal(
        params["segment_embeddings"]["embedding"],
        tensors["embeddings.token_type_embeddings.weight"],
    )


def test_prefixed_names_with_gamma_and_beta_load_the_same(tmp_path):
    tensors = small_tensors()
    plain, other = tmp_path / "plain", tmp_path / "other"
    plain.mkdir()
    other.mkdir()
    renamed = {}
    for name, tensor in tensors.items():
        name = name.replace("LayerNorm.weight", "LayerNorm.gamma")
        renamed["bert." + name.replace("LayerNorm.bias", "LayerNorm.beta")] = tensor
    renamed["cls.predictions.bias"] = np.zeros(VOCABULARY, np.float32)
    renamed["bert.embeddings.position_ids"] = np.arange(16)[None]
    expected = load_encoder(save_checkpoint(plain, tensors))
    found = load_encoder(save_checkpoint(other, renamed))
    assert jax.tree.structure(found.params) == jax.tree.structure(expected.params)
    jax.tree.map(np.testing.assert_array_equal, found.params, expected.params)


def test_half_precision_weights_become_float32(tmp_path):
    tensors = {name: tensor.astype(np.float16) for name, tensor in small_tensors().items()}
    encoder = load_encoder(save_checkpoint(tmp_path, tensors))
    assert {leaf.dtype for leaf in jax.tree.leaves(encoder.params)} == {jnp.dtype("float32")}


@pytest.mark.parametrize(
    "name", ["encoder.layer.1.attention.self.key.weight", "embeddings.LayerNorm.bias"]
)
def test_a_missing_tensor_is_named(tmp_path, name):
    tensors = small_tensors()
    shape = tensors.pop(name).shape
    with pytest.raises(EncoderWeightsError) as caught:
        load_encoder(save_checkpoint(tmp_path, tensors))
    assert name in str(caught.value)
    assert str(shape) in str(caught.value)


def test_a_misshapen_tensor_is_named_with_both_shapes(tmp_path):
    tensors = small_tensors()
    name = "encoder.layer.0.intermediate.dense.weight"
    tensors[name] = np.ascontiguousarray(tensors[name].T)
    with pytest.raises(
        EncoderWeightsError, match=r"expected shape \(12, 8\), found \(8, 12\)"
    ) as e:
        load_encoder(save_checkpoint(tmp_path, tensors))
    assert name in str(e.value)


def test_an_unexpected_tensor_is_named(tmp_path):
    tensors = small_tensors() | {"encoder.layer.2.output.dense.bias": np.zeros(8, np.float32)}
    with pytest.raises(EncoderWeightsError, match=r"encoder\.layer\.2\.output\.dense\.bias"):
        load_encoder(save_checkpoint(tmp_path, tensors))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model_type": "roberta"}, "model_type must be 'bert', found 'roberta'"),
        ({"position_embedding_type": "relative_key"}, "position_embedding_type must be"),
        ({"hidden_act": "silu"}, "activation must be one of"),
        ({"num_attention_heads": 3}, "heads|divi"),
        ({"num_attention_heads": None}, "does not state num_attention_heads"),
    ],
)
def test_other_configurations_are_refused(tmp_path, change, message):
    config = {name: value for name, value in (CONFIG | change).items() if value is not None}
    folder = save_checkpoint(tmp_path, small_tensors(), config)
    with pytest.raises(EncoderWeightsError, match=message):
        load_architecture(folder)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_missing_file_is_named(tmp_path, name):
    folder = save_checkpoint(tmp_path, small_tensors())
    (tmp_path / name).unlink()
    with pytest.raises(EncoderWeightsError, match=f"{name} is missing"):
        load_encoder(folder)


def test_a_damaged_weights_file_is_refused(tmp_path):
    folder = save_checkpoint(tmp_path, small_tensors())
    (tmp_path / "model.safetensors").write_bytes(b"not safetensors")
    with pytest.raises(EncoderWeightsError, match="no readable safetensors file"):
        load_encoder(folder)


def test_a_folder_without_a_tokenizer_is_refused(tmp_path):
    folder = save_checkpoint(tmp_path, small_tensors())
    with pytest.raises(EncoderWeightsError, match="holds no tokenizer"):
        load_tokenizer(folder)


def test_a_copied_folder_gives_the_packaged_encoder(tmp_path, packaged):
    source = checkpoint_folder()
    for name in ("config.json", "model.safetensors", "tokenizer.json", "tokenizer_config.json"):
        shutil.copy(source / name, tmp_path)
    copied = load_encoder(str(tmp_path))
    assert copied.architecture == packaged.architecture
    tensors = load_file(source / "model.safetensors")
    np.testing.assert_array_equal(
        copied.params["params"]["pooler"]["kernel"], tensors["pooler.dense.weight"].T
    )
    sentence = ["Deliver onion soup to the first serving location."]
    for ours, theirs in zip(
        tokenize(load_tokenizer(str(tmp_path)), sentence),
        tokenize(load_tokenizer(), sentence),
        strict=True,
    ):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("source", ["./no/such/folder", "/no/such/folder", "a/b/c", ""])
def test_a_source_that_is_neither_folder_nor_name_is_refused(source):
    with pytest.raises(EncoderWeightsError, match="neither a folder nor a model name"):
        load_encoder(source)


def test_a_name_that_the_hub_does_not_give_is_refused(monkeypatch):
    def offline(*_, **__):
        raise ConnectionError("no network")

    monkeypatch.setattr("huggingface_hub.snapshot_download", offline)
    with pytest.raises(EncoderWeightsError, match=r"could not be fetched .* give a local folder"):
        load_encoder("bert-base-uncased")
