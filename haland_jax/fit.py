"""One minibatch loop for every supervised stage: AdamW, warm-up and cosine decay, clipping, EMA.

The loop is a `lax.scan` inside one jitted function (a chunk); the driver calls chunk after chunk
and may save the `FitState` between them. Whatever is random comes from
`fold_in(state.key, state.step)`, so a run resumed from a saved state takes the very steps of an
uninterrupted one.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import serialization
from flax.struct import PyTreeNode

Params = Any
Metrics = dict[str, jax.Array]
SampleFn = Callable[[jax.Array, Any], Any]
LossFn = Callable[[Params, jax.Array, Any], tuple[jax.Array, Metrics]]


class NonFiniteLoss(ArithmeticError):
    """A metric of a supervised stage became infinite or not a number.

    Attributes:
        stage: name of the stage that was being fitted.
        step: first step (counted from 0) whose metric is not finite.
    """

    def __init__(self, stage: str, step: int, metric: str = "loss"):
        super().__init__(
            f"{stage}: {metric} is not finite at step {step}; "
            "lower the learning rate or inspect the data of this stage"
        )
        self.stage = stage
        self.step = step
        self.metric = metric

    def __reduce__(self):
        return type(self), (self.stage, self.step, self.metric)


@dataclass(frozen=True)
class FitConfig:
    """Optimiser and length of one supervised fit.

    Attributes:
        learning_rate: peak learning rate, > 0.
        steps: minibatch steps of the whole fit, >= 1.
        warmup_steps: steps of linear warm-up from 0, in [0, steps).
        final_learning_rate_fraction: end of the cosine decay, as a fraction of the peak, in [0, 1].
        clip_norm: largest global norm of the gradient, > 0.
        ema_decay: decay of the average of the parameters, in [0, 1); 0 keeps no average. It ramps
            up as min(ema_decay, (1 + step) / (10 + step)), so that the initialisation is soon
            forgotten.
        weight_decay: decoupled weight decay (AdamW), >= 0.
    """

    learning_rate: float
    steps: int
    warmup_steps: int = 0
    final_learning_rate_fraction: float = 0.0
    clip_norm: float = 1.0
    ema_decay: float = 0.0
    weight_decay: float = 0.0

    def __post_init__(self):
        expected = {
            "learning_rate": (self.learning_rate > 0, "> 0"),
            "steps": (self.steps >= 1, ">= 1"),
            "warmup_steps": (0 <= self.warmup_steps < self.steps, "in [0, steps)"),
            "final_learning_rate_fraction": (
                0 <= self.final_learning_rate_fraction <= 1,
                "in [0, 1]",
            ),
            "clip_norm": (self.clip_norm > 0, "> 0"),
            "ema_decay": (0 <= self.ema_decay < 1, "in [0, 1)"),
            "weight_decay": (self.weight_decay >= 0, ">= 0"),
        }
        for name, (valid, wanted) in expected.items():
            if not valid:
                raise ValueError(
                    f"FitConfig.{name} is {getattr(self, name)}; it has to be {wanted}"
                )


class FitState(PyTreeNode):
    """Everything a fit needs to go on.

    Attributes:
        step: int32 [], steps taken so far.
        key: typed key [], the same for the whole fit.
        params: the parameters being fitted.
        ema: exponential moving average of `params`; equal to them when `ema_decay` is 0.
        optimizer_state: optax state.
    """

    step: jax.Array
    key: jax.Array
    params: Params
    ema: Params
    optimizer_state: Any


def _to_state_dict(state: FitState) -> dict[str, Any]:
    fields = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    # Serialised forms hold plain arrays only; a typed key is not one.
    fields["key"] = jax.random.key_data(state.key)
    return {name: serialization.to_state_dict(value) for name, value in fields.items()}


def _from_state_dict(target: FitState, state_dict: dict[str, Any]) -> FitState:
    key = jax.random.wrap_key_data(
        jnp.asarray(state_dict["key"]), impl=jax.random.key_impl(target.key)
    )
    others = {
        name: serialization.from_state_dict(getattr(target, name), value, name=name)
        for name, value in state_dict.items()
        if name != "key"
    }
    return target.replace(key=key, **others)


serialization.register_serialization_state(
    FitState, _to_state_dict, _from_state_dict, override=True
)


def learning_rate_schedule(config: FitConfig) -> optax.Schedule:
    """Linear warm-up to the peak over `warmup_steps`, then cosine decay until `steps`."""
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0 if config.warmup_steps else config.learning_rate,
        peak_value=config.learning_rate,
        warmup_steps=config.warmup_steps,
        decay_steps=config.steps,
        end_value=config.learning_rate * config.final_learning_rate_fraction,
    )


def make_optimizer(config: FitConfig) -> optax.GradientTransformation:
    """AdamW on gradients clipped by their global norm, under the configured schedule."""
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm),
        optax.adamw(learning_rate_schedule(config), weight_decay=config.weight_decay),
    )


def init_fit(key: jax.Array, params: Params, config: FitConfig) -> FitState:
    """The state before the first step.

    `params` and `key` are copied, since a chunk donates (and so destroys) the state it is given.

    Args:
        key: typed key; kept in the state and folded with the step.
        params: initial parameters, any pytree of float arrays.
        config: the fit's configuration.
    """
    copy_key = jnp.array(jax.random.key_data(key), copy=True)
    return FitState(
        step=jnp.zeros((), jnp.int32),
        key=jax.random.wrap_key_data(copy_key, impl=jax.random.key_impl(key)),
        params=_copy(params),
        ema=_copy(params),
        optimizer_state=make_optimizer(config).init(params),
    )


def make_fit_chunk(
    loss_fn: LossFn, sample_fn: SampleFn, config: FitConfig, chunk_steps: int
) -> Callable[[FitState, Any], tuple[FitState, Metrics]]:
    """A jitted function that takes `chunk_steps` steps of the fit.

    Args:
        loss_fn: (params, key, batch) -> (loss [], metrics of scalars).
        sample_fn: (key, data) -> batch.
        config: the fit's configuration.
        chunk_steps: steps of one call; has to divide `config.steps`.

    Returns:
        chunk(state, data) -> (state, metrics). The given state is donated. Each metric is
        [chunk_steps], among them "loss" and "gradient_norm" (before clipping). A chunk called on a
        finished fit returns the parameters unchanged.

    Raises:
        ValueError: `chunk_steps` does not divide `config.steps`, or a metric has a reserved name.
    """
    if chunk_steps < 1 or config.steps % chunk_steps:
        raise ValueError(
            f"chunk_steps is {chunk_steps}; it has to be a positive divisor of "
            f"FitConfig.steps = {config.steps}"
        )
    optimizer = make_optimizer(config)

    def step_fn(state: FitState, data: Any) -> tuple[FitState, Metrics]:
        sample_key, loss_key = jax.random.split(jax.random.fold_in(state.key, state.step))
        batch = sample_fn(sample_key, data)
        (loss, metrics), gradient = jax.value_and_grad(loss_fn, has_aux=True)(
            state.params, loss_key, batch
        )
        reserved = {"loss", "gradient_norm"} & set(metrics)
        if reserved:
            raise ValueError(f"loss_fn returned metrics named {sorted(reserved)}; rename them")
        updates, optimizer_state = optimizer.update(gradient, state.optimizer_state, state.params)
        params = optax.apply_updates(state.params, updates)
        decay = jnp.minimum(config.ema_decay, (1 + state.step) / (10 + state.step))
        following = state.replace(
            step=state.step + 1,
            params=params,
            ema=optax.incremental_update(params, state.ema, 1 - decay),
            optimizer_state=optimizer_state,
        )
        unfinished = state.step < config.steps
        following = jax.tree.map(lambda new, old: jnp.where(unfinished, new, old), following, state)
        gradient_norm = optax.global_norm(gradient)
        return following, {**metrics, "loss": loss, "gradient_norm": gradient_norm}

    def chunk(state: FitState, data: Any) -> tuple[FitState, Metrics]:
        return jax.lax.scan(lambda s, _: step_fn(s, data), state, length=chunk_steps)

    return jax.jit(chunk, donate_argnums=0)


def check_finite(stage: str, first_step: int, metrics: Mapping[str, Any]) -> None:
    """Stop loudly where a metric of a chunk is not finite.

    Args:
        stage: name of the stage, for the message.
        first_step: step (from 0) that the first entry of each metric belongs to.
        metrics: name -> array with leading axis [chunk_steps].

    Raises:
        NonFiniteLoss: names the earliest step and its metric.
    """
    broken = {}
    for name, values in metrics.items():
        values = np.asarray(values)
        finite = np.isfinite(values.reshape(values.shape[0], -1)).all(axis=1)
        if not finite.all():
            broken[name] = int(finite.argmin())
    if broken:
        # "loss" is named where several metrics break at the same step.
        culprit = min(broken, key=lambda name: (broken[name], name != "loss"))
        raise NonFiniteLoss(stage, first_step + broken[culprit], culprit)


def _copy(tree: Params) -> Params:
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), tree)
