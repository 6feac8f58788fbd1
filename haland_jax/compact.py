"""Parameters in little space: large arrays in 8 bits, others in half precision.

An array of at least `LARGE` numbers is stored as int8 codes with one step for each column (what
the last but one axis runs over, along which a layer sums): an entry is off by at most half a step,
1/254 of the column's largest magnitude. Arrays of fewer than `SMALL` numbers, such as statistics
and biases, take next to no space and stay float32.
"""

from collections.abc import Container, Mapping
from typing import Any

import numpy as np
from flax import traverse_util

LARGE, SMALL = 30_000, 1_000
_CODES, _STEP = ":codes", ":step"
_HIGHEST_CODE = 127


def pack(tree: Mapping[str, Any], exact: Container[str] = ()) -> dict[str, np.ndarray]:
    """The arrays to store, by flat name such as "decoder/dense_0/kernel".

    Args:
        tree: nested dictionaries of float32 arrays; no key contains "/" or ":".
        exact: keys of the outermost dictionary whose arrays stay float32.

    Raises:
        ValueError: an array is not float32, not finite, or too large for half precision.
    """
    packed: dict[str, np.ndarray] = {}
    flat: dict[str, Any] = traverse_util.flatten_dict(dict(tree), sep="/")
    for name, leaf in flat.items():
        array = np.asarray(leaf)
        if array.dtype != np.float32:
            raise ValueError(f"'{name}' is {array.dtype}; expected float32")
        if not np.isfinite(array).all():
            raise ValueError(f"'{name}' has entries that are not finite; check the training")
        if name.split("/")[0] in exact:
            packed[name] = array
        elif array.size >= LARGE and array.ndim > 1:
            packed[name + _CODES], packed[name + _STEP] = _codes(array)
        elif array.size >= SMALL:
            if np.abs(array).max() > np.finfo(np.float16).max:
                raise ValueError(f"'{name}' has entries that are too large for half precision")
            packed[name] = array.astype(np.float16)
        else:
            packed[name] = array
    return packed


def unpack(packed: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The nested dictionaries given to `pack`, float32, each array as near as was stored.

    Raises:
        KeyError: codes without their steps.
    """
    flat = {}
    for name, array in packed.items():
        if name.endswith(_CODES):
            whole = name.removesuffix(_CODES)
            flat[whole] = array.astype(np.float32) * packed[whole + _STEP]
        elif not name.endswith(_STEP):
            flat[name] = array.astype(np.float32)
    return traverse_util.unflatten_dict(flat, sep="/")


def _codes(array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """int8 codes in [-127, 127] and float32 steps [..., 1, column] with array ≈ codes * steps."""
    largest = np.abs(array).max(axis=-2, keepdims=True)
    step = np.where(largest > 0, largest / _HIGHEST_CODE, 1.0).astype(np.float32)
    return np.rint(array / step).astype(np.int8), step
