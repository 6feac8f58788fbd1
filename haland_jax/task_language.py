"""The task language: what a style looks like as numbers, and as tokens (App. D, Eq. 8).

A style is described by the frequencies of its events, each divided by its largest value over the
styles, `v_hat` in [0, 1]. Eq. 8 cuts every dimension into V bins and numbers the bins of all
dimensions through. Environments without informative events use sinusoidal encodings of the label.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from flax.struct import PyTreeNode
from jax import Array

BINS = 10
"""V of Eq. 8 (App. D)."""

SLACK = 1e-4
"""δ of Eq. 8, which keeps a frequency of 1 in the last bin; App. D gives no value."""

TRANSLATION_ERROR = 1 / 3
"""How far from its style a translation is expected: standard deviation in each dimension, as a
share of the distance between the two styles that are most alike. Not in the paper; what it brings
is in docs/paper_map.md."""


class TaskLanguage(PyTreeNode):
    """The task language of one environment.

    Attributes:
        v_hat: [style, U], normalised frequencies, mean over the seeds, in [0, 1].
        v_hat_by_seed: [style, seed, U], the same of each pair, clipped to [0, 1].
        scale: [U], the frequency (events a step) that 1 stands for.
        event_names: U names, such as "partner:pickup_onion@left".
        dropped_event_names: names of the events that no pair ever showed.
    """

    v_hat: Array
    v_hat_by_seed: Array
    scale: Array
    event_names: tuple[str, ...] = struct.field(pytree_node=False)
    dropped_event_names: tuple[str, ...] = struct.field(pytree_node=False, default=())


def event_frequencies(counts: Array, steps: Array | float) -> Array:
    """Frequencies of events in events a step: sum over episodes of counts / sum of steps.

    Args:
        counts: [style, seed, agent, event] or [style, seed, episode, agent, event], >= 0.
        steps: length of the play counted, in steps, > 0: one number for each episode (or pair), or
            an array [style, seed] or [style, seed, episode].

    Returns:
        [style, seed, agent * event], the agent being the slower index, as in `agent_event_names`.

    Raises:
        ValueError: `counts` has another number of axes, a negative entry, or `steps` is not > 0.
    """
    totals = np.asarray(counts, np.float64)
    if totals.ndim not in (4, 5):
        raise ValueError(
            f"counts has shape {totals.shape}; expected [style, seed, agent, event] or "
            "[style, seed, episode, agent, event]"
        )
    if (totals < 0).any():
        raise ValueError("counts has negative entries; event counts are >= 0")
    lengths = np.broadcast_to(np.asarray(steps, np.float64), totals.shape[:-2])
    if (lengths <= 0).any():
        raise ValueError("steps has entries <= 0; pass the number of steps that were played")
    if totals.ndim == 5:
        totals, lengths = totals.sum(axis=2), lengths.sum(axis=2)
    frequencies = totals / lengths[..., None, None]
    return jnp.asarray(frequencies.reshape(*totals.shape[:2], -1), jnp.float32)


def agent_event_names(
    event_names: Sequence[str], agents: Sequence[str] = ("ego", "partner")
) -> tuple[str, ...]:
    """Names of `event_frequencies`' dimensions: "ego:..." for all events, then "partner:..."."""
    return tuple(f"{agent}:{event}" for agent in agents for event in event_names)


def build_task_language(frequencies: Array, names: Sequence[str]) -> TaskLanguage:
    """Drop events that nobody showed and normalise the others (App. D).

    A style's value is the mean over its seeds; "the largest frequency" of a dimension is the
    largest of these means, so that the most typical style of each event is at 1.

    Args:
        frequencies: [style, seed, E], events a step, >= 0.
        names: E names.

    Raises:
        ValueError: shapes disagree, a frequency is negative or not finite, or all are zero.
    """
    values = np.asarray(frequencies)
    if values.ndim != 3 or values.shape[-1] != len(names):
        raise ValueError(
            f"frequencies has shape {values.shape} beside {len(names)} names; expected "
            "[style, seed, number of names]"
        )
    if not np.isfinite(values).all() or (values < 0).any():
        raise ValueError("frequencies has negative or non-finite entries; check the rollouts")
    seen = np.asarray((values > 0).any(axis=(0, 1)))
    if not seen.any():
        raise ValueError("frequencies are all zero; the partners never caused an event")
    kept = values[..., seen]
    by_style = kept.mean(axis=1)
    scale = by_style.max(axis=0)
    return TaskLanguage(
        v_hat=jnp.asarray(by_style / scale, jnp.float32),
        v_hat_by_seed=jnp.asarray(np.clip(kept / scale, 0.0, 1.0), jnp.float32),
        scale=jnp.asarray(scale, jnp.float32),
        event_names=tuple(name for name, keep in zip(names, seen, strict=True) if keep),
        dropped_event_names=tuple(name for name, keep in zip(names, seen, strict=True) if not keep),
    )


def build_label_language(
    num_styles: int, num_seeds: int, features: int = 64, longest_period: float = 100.0
) -> TaskLanguage:
    """Task language of an environment whose styles are told apart by label alone (App. D).

    The sinusoids are moved from [-1, 1] to [0, 1], where Eq. 8's bins are; every seed of a style
    has the same values. The longest period is 100 and not the usual 10000: among some ten labels
    most dimensions would otherwise be constant.
    """
    encodings = (1.0 + sinusoidal_labels(num_styles, features, longest_period)) / 2.0
    half = features // 2
    return TaskLanguage(
        v_hat=encodings,
        v_hat_by_seed=jnp.repeat(encodings[:, None], num_seeds, axis=1),
        scale=jnp.ones(features),
        event_names=tuple(f"label:{wave}_{k}" for wave in ("sine", "cosine") for k in range(half)),
    )


def sinusoidal_labels(num_styles: int, features: int, longest_period: float) -> Array:
    """Sinusoidal encodings of the labels 0 .. num_styles - 1 (Vaswani et al., 2017).

    Returns:
        [style, features], in [-1, 1]: the sines sin(label * longest_period^(-2k / features)) for
        k = 0 .. features / 2 - 1, then the cosines.

    Raises:
        ValueError: `features` is odd or not positive.
    """
    if features < 2 or features % 2:
        raise ValueError(f"features is {features}; it has to be even and positive")
    frequencies = longest_period ** (-2.0 * np.arange(features // 2) / features)
    angles = np.arange(num_styles)[:, None] * frequencies
    return jnp.asarray(np.concatenate([np.sin(angles), np.cos(angles)], axis=1), jnp.float32)


def token_ids(v_hat: Array, bins: int = BINS, slack: float = SLACK) -> Array:
    """Eq. 8 with u counted from 0: floor(clip(v, 0, 1 - δ) * V) + u * V.

    Args:
        v_hat: [..., U], normalised frequencies; values outside [0, 1] are clipped.
        bins: V.
        slack: δ, > 0.

    Returns:
        int32 [..., U], in [0, U * V).
    """
    within = jnp.floor(jnp.clip(v_hat, 0.0, 1.0 - slack) * bins).astype(jnp.int32)
    return within + bins * jnp.arange(v_hat.shape[-1], dtype=jnp.int32)


def neighbouring_tokens(v_hat: Array, bins: int = BINS) -> tuple[Array, Array, Array]:
    """The two bins whose centres enclose each value, and the weight of the upper one.

    Bin k of a dimension has its centre at (k + 1/2) / V. At a centre the weight is 0 and the lower
    token is Eq. 8's; beyond the first and the last centre the nearest bin alone counts.

    Args:
        v_hat: [..., U]; values outside [0, 1] are clipped.
        bins: V, >= 2.

    Returns:
        lower and upper token ids, int32 [..., U]; weight of the upper, [..., U], in [0, 1].
    """
    position = jnp.clip(v_hat * bins - 0.5, 0.0, bins - 1.0)
    lower = jnp.minimum(jnp.floor(position), bins - 2.0)
    offset = bins * jnp.arange(v_hat.shape[-1], dtype=jnp.int32)
    lower_ids = lower.astype(jnp.int32) + offset
    return lower_ids, lower_ids + 1, position - lower


def nearest_style(v_hat: Array, style_v_hat: Array) -> Array:
    """Index of the style whose description is nearest in Euclidean distance.

    Args:
        v_hat: [..., U].
        style_v_hat: [style, U].

    Returns:
        int32 [...].
    """
    return jnp.argmin(_squared_distances(v_hat, style_v_hat), axis=-1).astype(jnp.int32)


def drawn_to_styles(v_hat: Array, style_v_hat: Array, error: float = TRANSLATION_ERROR) -> Array:
    """What style a translation means, as the task language that is expected given it.

    A translation is taken for the task language of one of the styles, all equally probable, plus a
    normal error. Near a style that gives the style's own task language, between two styles mostly
    that of the nearer one. The diffusion has met no other condition in training.

    Args:
        v_hat: translations, [..., U].
        style_v_hat: [style, U].
        error: standard deviation of the error in each dimension, as a share of the distance
            between the two styles that are most alike, > 0.

    Returns:
        [..., U], a mean of the styles' rows weighted by their probabilities.
    """
    between = jnp.sqrt(_squared_distances(style_v_hat, style_v_hat))
    closest = jnp.min(between, where=~jnp.eye(len(style_v_hat), dtype=bool), initial=jnp.inf)
    # Styles without a difference would make the error 0.
    deviation = jnp.maximum(error * closest, 1e-6)
    squared = _squared_distances(v_hat, style_v_hat)
    return jax.nn.softmax(-0.5 * squared / jnp.square(deviation), axis=-1) @ style_v_hat


def _squared_distances(v_hat: Array, style_v_hat: Array) -> Array:
    """Squared Euclidean distances of [..., U] from the styles' [style, U], [..., style]."""
    return jnp.sum(jnp.square(v_hat[..., None, :] - style_v_hat), axis=-1)


def jittered(key: Array, v_hat: Array, amplitude: float) -> Array:
    """`v_hat` plus uniform noise in [-amplitude, amplitude], clipped to [0, 1]. Consumes `key`."""
    noise = jax.random.uniform(key, v_hat.shape, minval=-amplitude, maxval=amplitude)
    return jnp.clip(v_hat + noise, 0.0, 1.0)
