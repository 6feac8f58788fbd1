"""The stages of a run: each reads what earlier ones made and writes what later ones need.

A stage is a function of a `Run`; it restores its own result if that is already there.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

import envs
from envs.instructions import Instructions, load_instructions
from experiments.configs import RunConfig
from experiments.progress import RunProgress, StageProgress
from experiments.run_folder import RunFolder
from experiments.training import Saver, run_fit, train_population
from haland_jax import (
    bert_weights,
    checkpoint,
    diffusion,
    fit,
    partners,
    policy_vae,
    task_language,
    translator,
)
from haland_jax.deployment import Haland
from haland_jax.diffusion import DiffusionParams, LatentArchive
from haland_jax.hypernetwork import PolicyArchitecture
from haland_jax.networks import Policy
from haland_jax.partners import Player, Population
from haland_jax.policy_vae import PolicyVAE
from haland_jax.population import over_population
from haland_jax.task_language import TaskLanguage

CURVE_POINTS = 40
VISIT_GAMES = 4


@dataclasses.dataclass
class Run:
    """What every stage is given."""

    config: RunConfig
    folder: RunFolder
    progress: RunProgress

    def __post_init__(self):
        self.env: Any = envs.make(self.config.environment, max_steps=self.config.max_steps)

    def key(self, stage: str) -> jax.Array:
        """The stage's own key: the same whichever stages ran before in this process."""
        root = jax.random.key(self.config.seed)
        return jax.random.fold_in(root, list(STAGES).index(stage))

    def instructions(self) -> dict[str, Instructions]:
        """The packaged sentences, in the order of the styles."""
        return load_instructions(self.config.environment, self.env.style_names)

    def path(self, stage: str, name: str):
        """Where a checkpoint of a stage lies."""
        return self.folder.stage_path(stage) / name


class Archive(PyTreeNode):
    """Best responses and the Oracles.

    Attributes:
        egos: refitted egos, leading axes [style, train_seeds].
        oracles: the best ego for each held-out partner, actors [style, held_out_seeds].
        oracle_returns: their mean return in selection games, [style, held_out_seeds, candidate].
    """

    egos: Player
    oracles: Policy
    oracle_returns: jax.Array


def make_partners(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1a: trains pairs of every style and seed together and keeps the best."""
    config, env = run.config.partners, run.env
    train_key, play_key = jax.random.split(run.key("partners"))
    state, rewards = train_population(
        env,
        config.joint,
        lambda: partners.init_pairs(env, config, train_key),
        partners.repeat_styles(env, config.num_seeds),
        Saver(run.path("partners", "unfinished")),
        task.update,
        "partners",
    )
    returns = _mean_returns(run, play_key, state.ego.actor, state.partner.actor, config.num_seeds)
    population = partners.make_population(env, config, state, returns)
    checkpoint.save(run.path("partners", "population"), population)
    points = np.linspace(0, len(rewards), min(CURVE_POINTS, len(rewards)) + 1).astype(int)
    smooth = [rewards[a:b].mean(0) for a, b in zip(points[:-1], points[1:], strict=True)]
    by_style = np.array(smooth).reshape(len(smooth), len(env.style_names), -1) * env.max_steps
    return {
        "joint_returns": dict(zip(env.style_names, returns.tolist(), strict=True)),
        "kept_for_training": np.asarray(population.train_index),
        "kept_held_out": np.asarray(population.held_out_index),
        "curve_steps": points[1:] * config.joint.steps_per_update,
        "curve_returns": {name: by_style[:, index].T for index, name in enumerate(env.style_names)},
    }


def load_population(run: Run) -> Population:
    """The partners that `make_partners` kept."""
    config, env = run.config.partners, run.env
    shapes = jax.eval_shape(lambda key: partners.init_pairs(env, config, key), jax.random.key(0))

    def seeds(tree: Any, count: int) -> Any:
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(
                (len(env.style_names), count, *leaf.shape[1:]), leaf.dtype
            ),
            tree,
        )

    egos = Player(shapes.ego.actor, shapes.ego.critic)
    train, held_out = config.train_seeds, config.held_out_seeds
    styles = len(env.style_names)
    like = Population(
        train_partners=seeds(shapes.partner.actor, train),
        held_out_partners=seeds(shapes.partner.actor, held_out),
        train_egos=seeds(egos, train),
        held_out_egos=seeds(egos, held_out),
        joint_returns=jax.ShapeDtypeStruct((styles, config.num_seeds), jnp.float32),
        train_index=jax.ShapeDtypeStruct((styles, train), jnp.int32),
        held_out_index=jax.ShapeDtypeStruct((styles, held_out), jnp.int32),
    )
    return checkpoint.restore(run.path("partners", "population"), like)


def make_best_responses(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 1b: refits the egos, which become the archive, and finds the Oracles."""
    config, env = run.config.partners, run.env
    population = load_population(run)
    refit_key, oracle_key, play_key = jax.random.split(run.key("best_responses"), 3)
    refitted, _ = train_population(
        env,
        config.refit,
        lambda: partners.best_response_refits(env, config, refit_key, population),
        partners.repeat_styles(env, config.train_seeds),
        Saver(run.path("best_responses", "unfinished_refits")),
        task.update,
        "best responses",
    )
    num_styles = len(env.style_names)
    egos = partners.unflatten(Player(refitted.ego.actor, refitted.ego.critic), num_styles)
    candidates = config.held_out_seeds * config.oracle_candidates
    offset = config.refit.num_updates
    trained, _ = train_population(
        env,
        config.oracle,
        lambda: partners.oracle_refits(env, config, oracle_key, population, egos),
        partners.repeat_styles(env, candidates),
        Saver(run.path("best_responses", "unfinished_oracles")),
        lambda done, metrics: task.update(offset + done, metrics),
        "oracles",
    )
    repeated = jax.tree.map(
        lambda leaf: jnp.repeat(leaf, config.oracle_candidates, axis=1),
        population.held_out_partners,
    )
    returns = _mean_returns(
        run, play_key, trained.ego.actor, partners.flatten(repeated), candidates
    ).reshape(num_styles, config.held_out_seeds, config.oracle_candidates)
    best = returns.argmax(axis=2)
    actors = jax.tree.map(
        lambda leaf: leaf.reshape(*returns.shape, *leaf.shape[1:]), trained.ego.actor
    )
    rows, columns = np.indices(best.shape)
    archive = Archive(
        egos=egos,
        oracles=jax.tree.map(lambda leaf: leaf[rows, columns, best], actors),
        oracle_returns=jnp.asarray(returns, jnp.float32),
    )
    checkpoint.save(run.path("best_responses", "archive"), archive)
    return {"oracle_candidate_returns": returns}


def load_archive(run: Run) -> Archive:
    """The best responses and Oracles that `make_best_responses` kept."""
    config = run.config.partners
    population = load_population(run)
    shape = (len(run.env.style_names), config.held_out_seeds, config.oracle_candidates)
    like = Archive(
        egos=population.train_egos,
        oracles=population.held_out_egos.actor,
        oracle_returns=jnp.zeros(shape),
    )
    return checkpoint.restore(run.path("best_responses", "archive"), like)


def make_task_language(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 2: counts events in games of the best responses with their training partners."""
    env, games = run.env, run.config.task_language_games
    population, archive = load_population(run), load_archive(run)
    times = run.config.partners.train_seeds
    play = partners.compile_evaluation(env, games)
    keys = jax.random.split(run.key("task_language"), len(env.style_names) * times)
    played = play(
        keys,
        partners.flatten(archive.egos.actor),
        partners.flatten(population.train_partners),
        partners.repeat_styles(env, times),
    )
    task.update(1)
    counts = partners.unflatten(played.events, len(env.style_names))
    lengths = partners.unflatten(played.lengths, len(env.style_names))
    names = task_language.agent_event_names(env.event_names, envs.AGENTS)
    language = task_language.build_task_language(
        task_language.event_frequencies(counts, np.asarray(lengths)), names
    )
    checkpoint.save(
        run.path("task_language", "language"),
        {"v_hat": language.v_hat, "by_seed": language.v_hat_by_seed, "scale": language.scale},
        {"events": list(language.event_names), "dropped": list(language.dropped_event_names)},
    )
    return {"events": len(language.event_names), "dropped": len(language.dropped_event_names)}


def load_task_language(run: Run) -> TaskLanguage:
    """What `make_task_language` counted."""
    path = run.path("task_language", "language")
    arrays, names = checkpoint.restore(path), checkpoint.read_metadata(path)
    return TaskLanguage(
        v_hat=jnp.asarray(arrays["v_hat"]),
        v_hat_by_seed=jnp.asarray(arrays["by_seed"]),
        scale=jnp.asarray(arrays["scale"]),
        event_names=tuple(names["events"]),
        dropped_event_names=tuple(names["dropped"]),
    )


def fit_policy_vae(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 3: compresses the archive; states of decoded policies join as the fit goes on."""
    config, env = run.config.compression, run.env
    population, archive = load_population(run), load_archive(run)
    policies = partners.flatten(archive.egos.actor)
    init_key, fit_key, state_key = jax.random.split(run.key("policy_vae"), 3)
    vae, params = init_vae(run, init_key, policies)
    visits = Visits(run, population)
    own, other, decoded = config.own_states, config.other_states, config.decoded_states
    own_key, other_key, decoded_key = jax.random.split(state_key, 3)
    fixed = jnp.concatenate(
        [
            visits.own_partners(own_key, policies, own),
            visits.other_partners(other_key, policies, other),
        ],
        axis=1,
    )
    first = visits.own_partners(decoded_key, policies, decoded)
    data = {"policies": policies, "states": jnp.concatenate([fixed, first], axis=1)}

    def refresh(state: fit.FitState, data: dict[str, Any]) -> dict[str, Any]:
        posterior = policy_vae.encode(vae, state.params, policies)
        rebuilt = policy_vae.decode(vae, state.params, posterior.mean)
        key = jax.random.fold_in(decoded_key, state.step)
        newest = visits.own_partners(key, rebuilt, decoded // 2)
        kept = data["states"][:, fixed.shape[1] + decoded // 2 :]
        return {**data, "states": jnp.concatenate([fixed, kept, newest], axis=1)}

    chunk = fit.make_fit_chunk(
        policy_vae.make_loss_fn(vae),
        policy_vae.make_sample_fn(config.vae),
        config.fit,
        config.chunk_steps,
    )
    state, history = run_fit(
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
    return {name: values[-1] for name, values in history.items()}


def init_vae(run: Run, key: jax.Array, policies: Policy) -> tuple[PolicyVAE, Any]:
    """A policy VAE for policies with a leading axis, and fresh parameters."""
    one = jax.tree.map(lambda leaf: leaf[0], policies)
    vae = PolicyVAE(PolicyArchitecture.from_params(one), run.config.compression.vae)
    return vae, jax.jit(vae.init)(key, one)


class Visits:
    """States that policies visit in games with training partners; one compiled program."""

    def __init__(self, run: Run, population: Population):
        self.run = run
        self.partners = population.train_partners
        self._programs: dict[int, Any] = {}

    def own_partners(self, key: jax.Array, policies: Policy, number: int) -> jax.Array:
        """States of each policy [member] with its own partner, [member, number, O]."""
        return self._visit(key, policies, number, shift=0)

    def other_partners(self, key: jax.Array, policies: Policy, number: int) -> jax.Array:
        """States of each policy with a partner of another style, [member, number, O]."""
        return self._visit(key, policies, number, shift=1)

    def _visit(self, key: jax.Array, policies: Policy, number: int, shift: int) -> jax.Array:
        env, times = self.run.env, self.run.config.partners.train_seeds
        if number not in self._programs:
            self._programs[number] = over_population(
                partial(partners.visited_observations, env, num_games=VISIT_GAMES, num_kept=number)
            )
        rolled = jax.tree.map(lambda leaf: jnp.roll(leaf, shift, axis=0), self.partners)
        styles = partners.repeat_styles(env, times)
        styles = jax.tree.map(lambda leaf: jnp.roll(leaf, shift * times, axis=0), styles)
        keys = jax.random.split(key, len(env.style_names) * times)
        return self._programs[number](keys, policies, partners.flatten(rolled), styles)


def load_vae(run: Run) -> tuple[PolicyVAE, Any, policy_vae.Posterior]:
    """The policy VAE, its parameters, and the archive's latents [policy, D]."""
    policies = partners.flatten(load_archive(run).egos.actor)
    vae, params = init_vae(run, jax.random.key(0), policies)
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
    statistics = diffusion.latent_statistics(archive)
    init_key, fit_key = jax.random.split(run.key("diffusion"))
    params = diffusion.init_network(init_key, config, v_hat.shape[-1])
    chunk = fit.make_fit_chunk(
        diffusion.make_diffusion_loss(config),
        diffusion.make_sample_fn(config, statistics),
        config.fit,
        max(1, config.fit.steps // 20),
    )
    state, history = run_fit(
        "diffusion",
        config.fit,
        chunk,
        fit.init_fit(fit_key, params, config.fit),
        archive,
        Saver(run.path("diffusion", "unfinished")),
        task,
    )
    checkpoint.save(run.path("diffusion", "model"), DiffusionParams(state.ema, statistics))
    return {name: values[-1] for name, values in history.items()}


def load_diffusion(run: Run) -> DiffusionParams:
    """The fitted diffusion."""
    config, size = run.config.diffusion, run.config.diffusion.latent_size
    events = load_task_language(run).v_hat.shape[-1]
    network = diffusion.init_network(jax.random.key(0), config, events)
    statistics = diffusion.LatentStatistics(jnp.zeros(size), jnp.ones(size))
    return checkpoint.restore(run.path("diffusion", "model"), DiffusionParams(network, statistics))


def fit_translator(run: Run, task: StageProgress) -> dict[str, Any]:
    """Stage 5: fine-tunes BERT on the training sentences, then fits the translation."""
    config = run.config.translator
    language = load_task_language(run)
    encoder = bert_weights.load_encoder(run.config.encoder or None)
    tokenizer = bert_weights.load_tokenizer(run.config.encoder or None)
    instructions = run.instructions()
    sentences = [s for style in instructions.values() for s in style.train]
    labels = [i for i, style in enumerate(instructions.values()) for _ in style.train]
    ids, mask = bert_weights.tokenize(tokenizer, sentences, config.maximum_length)
    prepared = translator.prepare_sentences(encoder, config, ids, mask, np.array(labels))
    keys = jax.random.split(run.key("translator"), 5)
    tuned, first = _two_saves(
        run,
        task,
        "fine-tuning",
        config.fine_tuning,
        translator.make_fine_tuning(encoder.architecture, config),
        translator.init_fine_tuning(keys[0], encoder, config, len(instructions)),
        keys[1],
        prepared,
        offset=0,
    )
    data = translator.prepare_translation(
        keys[2], tuned, encoder.architecture, config, prepared, language.v_hat
    )
    vae, second = _two_saves(
        run,
        task,
        "translation",
        config.translation,
        translator.make_translation(config),
        translator.init_translation(
            keys[3], encoder.architecture, config, language.v_hat.shape[-1]
        ),
        keys[4],
        data,
        offset=config.fine_tuning.steps,
    )
    checkpoint.save(run.path("translator", "model"), {"fine_tuned": tuned, "vae": vae})
    return {**{f"fine_tuning_{k}": v for k, v in first.items()}, **second}


def _two_saves(run, task, name, config, functions, params, key, data, *, offset):
    """One of the translator's two fits."""
    loss_fn, sample_fn = functions
    chunk = fit.make_fit_chunk(loss_fn, sample_fn, config, max(1, config.steps // 10))
    state, history = run_fit(
        f"translator ({name})",
        config,
        chunk,
        fit.init_fit(key, params, config),
        data,
        Saver(run.path("translator", f"unfinished_{name.replace('-', '_')}")),
        task,
        offset=offset,
    )
    return state.params, {metric: values[-1] for metric, values in history.items()}


def load_haland(run: Run) -> Haland:
    """Everything that a sentence needs to become a policy."""
    config = run.config.translator
    language = load_task_language(run)
    encoder = bert_weights.load_encoder(run.config.encoder or None)
    fine_tuned = translator.init_fine_tuning(
        jax.random.key(0), encoder, config, len(run.env.style_names)
    )
    events = language.v_hat.shape[-1]
    vae = translator.init_translation(jax.random.key(0), encoder.architecture, config, events)
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
        tokenizer=bert_weights.load_tokenizer(run.config.encoder or None),
        style_names=run.env.style_names,
        v_hat=language.v_hat,
    )


def _mean_returns(
    run: Run, key: jax.Array, egos: Policy, partner_policies: Policy, seeds: int
) -> np.ndarray:
    """Mean return of each pair [style * seeds], as [style, seeds]."""
    env = run.env
    play = partners.compile_evaluation(env, run.config.partners.evaluation_games)
    keys = jax.random.split(key, len(env.style_names) * seeds)
    games = play(keys, egos, partner_policies, partners.repeat_styles(env, seeds))
    return np.asarray(games.returns.mean(axis=1)).reshape(len(env.style_names), seeds)


STAGES = {
    "partners": make_partners,
    "best_responses": make_best_responses,
    "task_language": make_task_language,
    "policy_vae": fit_policy_vae,
    "diffusion": fit_diffusion,
    "translator": fit_translator,
}
