"""Policy VAE, latent diffusion and translator: what turns a sentence into a policy."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.instructions import Instructions, training_sentences
from experiments.errors import as_user_error
from experiments.progress import StageProgress
from experiments.stages.best_responses import load_archive, load_task_language
from experiments.stages.context import SENTENCES, Run
from experiments.stages.population import load_population
from experiments.training import Saver, run_fit
from haland_jax import (
    bert_weights,
    checkpoint,
    diffusion,
    fit,
    mirrors,
    partners,
    policy_vae,
    rollout,
    translator,
)
from haland_jax.bert import BertArchitecture
from haland_jax.deployment import Haland
from haland_jax.diffusion import DiffusionConfig, DiffusionParams, LatentArchive
from haland_jax.hypernetwork import PolicyArchitecture
from haland_jax.networks import Policy
from haland_jax.partners import Population
from haland_jax.policy_vae import PolicyVAE
from haland_jax.population import over_population

STEPS_FOR_A_STATE = 4
"""Steps of full games from which one state is drawn, so that few are drawn twice."""


def fit_policy_vae(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 3: compresses the archive, on fresh states after each piece of the fit."""
    config = run.config.compression
    population, archive = load_population(run), load_archive(run)
    policies = partners.flatten(archive.egos.actor)
    init_key, fit_key, state_key = jax.random.split(run.key("policy_vae"), 3)
    vae, params = init_vae(run, init_key, policies)
    visits = Visits(run, population)

    def data_of(step: jax.Array | int, rebuilt: Policy) -> dict[str, Any]:
        """The policies, and states of all kinds for the piece that begins at `step`."""
        keys = jax.random.split(jax.random.fold_in(state_key, step), 3)
        states = [
            visits.own_partners(keys[0], policies, config.own_states),
            visits.other_partners(keys[1], policies, config.other_states),
            visits.own_partners(keys[2], rebuilt, config.decoded_states),
        ]
        return {"policies": policies, "states": jnp.concatenate(states, axis=1)}

    def refresh(state: fit.FitState) -> dict[str, Any]:
        # No state is kept: those that are seen again are learnt by heart.
        posterior = policy_vae.encode(vae, state.params, policies)
        return data_of(state.step, policy_vae.decode(vae, state.params, posterior.mean))

    data = data_of(0, policies)  # Nothing is decoded yet.
    params = policy_vae.with_statistics(params, data["states"])
    chunk = fit.make_fit_chunk(
        policy_vae.make_loss_fn(vae),
        policy_vae.make_sample_fn(config.vae),
        config.fit,
        config.chunk_steps,
    )
    state, metrics = run_fit(
        "policy VAE",
        config.fit,
        chunk,
        fit.init_fit(fit_key, params, config.fit),
        data,
        Saver(run.path("policy_vae", "unfinished")),
        task,
        refresh=refresh,
    )
    posterior = policy_vae.encode(vae, state.params, policies)
    checkpoint.save(
        run.path("policy_vae", "vae"),
        {"params": state.params, "mean": posterior.mean, "log_variance": posterior.log_variance},
    )
    return metrics


def init_vae(run: Run, key: jax.Array, policies: Policy) -> tuple[PolicyVAE, Any]:
    """A policy VAE for policies with a leading axis, and fresh parameters."""
    one = jax.tree.map(lambda leaf: leaf[0], policies)
    vae = PolicyVAE(PolicyArchitecture.from_params(one), run.config.compression.vae)
    return vae, jax.jit(vae.init)(key, one)


class Visits:
    """States that policies visit in games with each partner that egos learn with.

    Games are shared out over the devices; the states are for a fit, which has one. One program
    draws as many states as are ever wanted at once.
    """

    def __init__(self, run: Run, population: Population):
        self.run = run
        self.teachers = mirrors.teachers(run.env, run.config.partners, population)
        wanted = run.config.compression
        most = max(wanted.own_states, wanted.other_states, wanted.decoded_states)
        steps = jax.tree.leaves(self.teachers)[0].shape[1] * run.config.max_steps
        visit = partial(
            rollout.visited_observations,
            run.env,
            num_kept=most,
            games_each=-(-STEPS_FOR_A_STATE * most // steps),
        )
        self._visited = over_population(visit, compiler_options=run.env.compiler_options)

    def own_partners(self, key: jax.Array, policies: Policy, number: int) -> jax.Array:
        """States of each policy [member] with partners of its style, [member, number, O]."""
        return self._visit(key, policies, number, shift=0)

    def other_partners(self, key: jax.Array, policies: Policy, number: int) -> jax.Array:
        """States of each policy with partners of another style, [member, number, O]."""
        return self._visit(key, policies, number, shift=1)

    def _visit(self, key: jax.Array, policies: Policy, number: int, shift: int) -> jax.Array:
        env, times = self.run.env, self.run.config.partners.train_seeds
        others = _for_each_policy(self.teachers, times, shift)
        styles = _for_each_policy(env.styles, times, shift)
        keys = jax.random.split(key, len(env.style_names) * times)
        states = self._visited(keys, policies, others, styles)
        return jax.device_put(states[:, :number], jax.devices()[0])


@partial(jax.jit, static_argnums=(1, 2))
def _for_each_policy(by_style: Any, times: int, shift: int) -> Any:
    """What belongs to the style `shift` places before that of each policy [style * times]."""
    return jax.tree.map(
        lambda leaf: jnp.repeat(jnp.roll(leaf, shift, axis=0), times, axis=0), by_style
    )


def load_vae(run: Run) -> tuple[PolicyVAE, Any, policy_vae.Posterior]:
    """The policy VAE, its parameters, and the archive's latents [policy, D]."""
    policies = partners.flatten(load_archive(run).egos.actor)
    one = jax.tree.map(lambda leaf: leaf[0], policies)
    vae = PolicyVAE(PolicyArchitecture.from_params(one), run.config.compression.vae)
    params = jax.eval_shape(vae.init, jax.random.key(0), one)
    latents = jnp.zeros((jax.tree.leaves(policies)[0].shape[0], vae.config.latent_dim))
    like = {"params": params, "mean": latents, "log_variance": latents}
    saved = checkpoint.restore(run.path("policy_vae", "vae"), like)
    return vae, saved["params"], policy_vae.Posterior(saved["mean"], saved["log_variance"])


def fit_diffusion(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 4: fits the latent diffusion on the archive's latents and task language."""
    config = run.config.diffusion
    language = load_task_language(run)
    _, _, posterior = load_vae(run)
    times = run.config.partners.train_seeds
    v_hat = jnp.repeat(language.v_hat, times, axis=0)
    archive = LatentArchive(posterior.mean, posterior.log_variance, v_hat)
    params, metrics = fit_latent_diffusion(
        run.key("diffusion"), config, archive, Saver(run.path("diffusion", "unfinished")), task
    )
    checkpoint.save(run.path("diffusion", "model"), params)
    return metrics


def fit_latent_diffusion(
    key: jax.Array,
    config: DiffusionConfig,
    archive: LatentArchive,
    saver: Saver,
    task: StageProgress,
) -> tuple[DiffusionParams, dict[str, float]]:
    """Fits a diffusion on what is conditioned on what; returns it and its last metrics.

    Args:
        key: consumed.
        config: sizes and fit.
        archive: latents and conditions.
        saver: where an interrupted fit goes on from.
        task: progress.
    """
    statistics = diffusion.latent_statistics(archive)
    init_key, fit_key = jax.random.split(key)
    params = diffusion.init_network(init_key, config, archive.v_hat.shape[-1])
    chunk = fit.make_fit_chunk(
        diffusion.make_diffusion_loss(config),
        diffusion.make_sample_fn(config, statistics),
        config.fit,
        max(1, config.fit.steps // 20),
    )
    state = fit.init_fit(fit_key, params, config.fit)
    state, metrics = run_fit("diffusion", config.fit, chunk, state, archive, saver, task)
    return DiffusionParams(state.ema, statistics), metrics


def load_diffusion(run: Run) -> DiffusionParams:
    """The fitted diffusion."""
    config, size = run.config.diffusion, run.config.diffusion.latent_size
    events = load_task_language(run).v_hat.shape[-1]
    network = jax.eval_shape(
        lambda key: diffusion.init_network(key, config, events), jax.random.key(0)
    )
    statistics = diffusion.LatentStatistics(jnp.zeros(size), jnp.ones(size))
    return checkpoint.restore(run.path("diffusion", "model"), DiffusionParams(network, statistics))


def load_pretrained(run: Run) -> tuple[bert_weights.Encoder, Any]:
    """The run's pre-trained encoder and its tokenizer.

    Raises:
        UserError: they are missing or do not fit.
    """
    source = run.config.encoder or None
    with as_user_error(bert_weights.EncoderWeightsError):
        return bert_weights.load_encoder(source), bert_weights.load_tokenizer(source)


def prepare_instructions(
    instructions: Mapping[str, Instructions],
    encoder: bert_weights.Encoder,
    tokenizer: Any,
    config: translator.TranslatorConfig,
) -> translator.SentenceData:
    """The training sentences of all styles after the frozen part of the encoder."""
    sentences, styles = training_sentences(instructions)
    tokens = bert_weights.tokenize(tokenizer, sentences, config.maximum_length)
    return translator.prepare_sentences(encoder, config, *tokens, np.array(styles))


def fit_translator(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 5: fine-tunes BERT on the training sentences, then fits the translation."""
    config = run.config.translator
    language = load_task_language(run)
    encoder, tokenizer = load_pretrained(run)
    prepared = prepare_instructions(run.instructions(), encoder, tokenizer, config)
    keys = jax.random.split(run.key("translator"), 4)
    initial = translator.init_fine_tuning(encoder, config, len(run.env.style_names))
    fine_tunings, first = _fit_part(
        "fine-tuning",
        config.fine_tuning,
        translator.make_fine_tuning(encoder.architecture, config),
        translator.start_fine_tunings(initial, config),
        keys[0],
        prepared,
        Saver(run.path("translator", "unfinished_fine_tuning")),
        task,
    )
    tuned = translator.average_fine_tunings(fine_tunings)
    vae, second = fit_translation(
        keys[1:],
        config,
        encoder.architecture,
        tuned,
        prepared,
        language.v_hat,
        Saver(run.path("translator", "unfinished_translation")),
        task,
        offset=config.fine_tuning.steps,
    )
    checkpoint.save(run.path("translator", "model"), {"fine_tuned": tuned, "vae": vae})
    learnt = {f"fine_tuning_{k}": v for k, v in first.items()}
    return {**learnt, **second, SENTENCES: run.sentences_digest()}


def fit_translation(
    keys: jax.Array,
    config: translator.TranslatorConfig,
    architecture: BertArchitecture,
    tuned: Any,
    prepared: translator.SentenceData,
    v_hat: jax.Array,
    saver: Saver,
    task: StageProgress,
    *,
    offset: int = 0,
) -> tuple[Any, dict[str, float]]:
    """Fits the translation's VAE on sentences; returns its parameters and last metrics.

    Args:
        keys: three; consumed.
        config: the translator's.
        architecture: the encoder's.
        tuned: the encoder's last layers and the classifier, as `init_fine_tuning` makes them.
        prepared: the sentences.
        v_hat: task language of each style, [style, U].
        saver: where an interrupted fit goes on from.
        task: progress.
        offset: steps of the stage before this fit.
    """
    data = translator.prepare_translation(keys[0], tuned, architecture, config, prepared, v_hat)
    return _fit_part(
        "translation",
        config.translation,
        translator.make_translation(config),
        translator.init_translation(keys[1], architecture, config, v_hat.shape[-1]),
        keys[2],
        data,
        saver,
        task,
        offset=offset,
    )


def _fit_part(name, config, functions, params, key, data, saver, task, *, offset=0):
    """One of the translator's two fits."""
    loss_fn, sample_fn = functions
    chunk = fit.make_fit_chunk(loss_fn, sample_fn, config, max(1, config.steps // 10))
    state, metrics = run_fit(
        f"translator ({name})",
        config,
        chunk,
        fit.init_fit(key, params, config),
        data,
        saver,
        task,
        offset=offset,
    )
    return state.params, metrics


def load_haland(run: Run) -> Haland:
    """Everything that a sentence needs to become a policy."""
    config = run.config.translator
    language = load_task_language(run)
    encoder, tokenizer = load_pretrained(run)
    events, styles = language.v_hat.shape[-1], len(run.env.style_names)
    # Shapes alone: to compile and compute initial values would take most of the time.
    fine_tuned, vae = jax.eval_shape(
        lambda key: (
            translator.init_fine_tuning(encoder, config, styles),
            translator.init_translation(key, encoder.architecture, config, events),
        ),
        jax.random.key(0),
    )
    saved = checkpoint.restore(
        run.path("translator", "model"), {"fine_tuned": fine_tuned, "vae": vae}
    )
    vae_module, vae_params, _ = load_vae(run)
    return Haland(
        architecture=vae_module.architecture,
        vae_config=vae_module.config,
        vae_params=vae_params,
        diffusion_config=run.config.diffusion,
        diffusion_params=load_diffusion(run),
        translator=translator.assemble_translator(
            encoder, config, saved["fine_tuned"], saved["vae"]
        ),
        tokenizer=tokenizer,
        style_names=run.env.style_names,
        v_hat=language.v_hat,
    )
