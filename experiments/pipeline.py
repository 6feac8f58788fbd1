"""The stages in order; each reads and writes artefacts, and a finished one is not run again."""

import time
from pathlib import Path
from typing import Any

from experiments import report
from experiments.compared import with_compared
from experiments.configs import RunConfig
from experiments.evaluation import evaluate
from experiments.gallery import record_episodes
from experiments.machine import describe_machine
from experiments.progress import RunProgress
from experiments.run_folder import RunFolder
from experiments.stages import STAGES, Run
from haland_jax.universal import start_variants

EVALUATION, REPORT = "evaluation", "report"
NUM_METHODS = 8


def run_pipeline(config: RunConfig, path: Path) -> dict[str, Any]:
    """Runs, or continues, everything from partners to report.

    Args:
        config: the run's configuration.
        path: the run folder.

    Returns:
        The content of `results.json`.
    """
    names = (*STAGES, EVALUATION, REPORT)
    with RunFolder.write(path, config) as folder, RunProgress(names, folder) as progress:
        run = Run(config, folder)
        totals = _totals(config)
        if folder.recorded_in is not None:
            folder.expect_stages(STAGES)
        for name, stage in STAGES.items():
            if folder.stage_done(name):
                progress.skip(name)
                continue
            start = time.monotonic()
            with progress.stage(name, totals[name]) as task:
                metrics = stage(run, task)
            folder.finish_stage(name, {**metrics, "seconds": time.monotonic() - start})
        if folder.stage_done(EVALUATION):
            progress.skip(EVALUATION)
        else:
            start = time.monotonic()
            with progress.stage(EVALUATION, NUM_METHODS) as task:
                measured = evaluate(run, task)
            folder.finish_stage(EVALUATION, {**measured, "seconds": time.monotonic() - start})
        if folder.stage_done(REPORT):
            progress.skip(REPORT)
            results = folder.read_json("results.json")
        else:
            results = with_compared(collect_results(run), folder)
            folder.write_json("results.json", results)
            with progress.stage(REPORT, len(run.env.style_names)) as task:
                results["episodes"] = record_episodes(run, task)
                folder.write_json("results.json", results)
                report.write_report(results, path)
            folder.finish_stage(REPORT, {})
    return results


def collect_results(run: Run) -> dict[str, Any]:
    """Joins what the stages measured into the content of `results.json`."""
    metrics = {name: run.folder.stage_metrics(name) for name in (*STAGES, EVALUATION)}
    measured = dict(metrics[EVALUATION])
    measured.pop("seconds")
    return {
        "environment": run.config.environment,
        "preset": run.config.preset,
        "seed": run.config.seed,
        "styles": list(run.env.style_names),
        **measured,
        "curves": {
            "steps": metrics["partners"]["curve_steps"],
            "returns": metrics["partners"]["curve_returns"],
        },
        "universal": _universal(run, metrics["universal"]),
        "partners": {
            name: metrics["partners"][name]
            for name in ("joint_returns", "kept_for_training", "kept_held_out")
        },
        "best_responses": {
            name: value
            for name, value in metrics["best_responses"].items()
            if name not in ("seconds", "oracle_candidate_returns")
        },
        "times": {name: values["seconds"] for name, values in metrics.items()},
        "machine": describe_machine(),
    }


def _universal(run: Run, measured: dict[str, Any]) -> dict[str, Any]:
    """How the universal egos learnt, and what the best responses cost beside them.

    They cost the pairs that they start from, those of held-out partners not among them, the
    universal egos that they may start from, and their refits.
    """
    config = run.config.partners
    styles = len(run.env.style_names)
    pairs = styles * config.known_seeds * config.joint.num_updates * config.joint.steps_per_update
    starts = len(start_variants(config)) * measured["seeds"]
    refits = styles * config.train_seeds * config.refit_updates * config.refit.steps_per_update
    kept = ("steps", "seeds", "curve_steps", "curve_returns")
    return {
        **{name: measured[name] for name in kept},
        # A stage that was finished before anybody guided does not say it.
        "guided_steps": measured.get("guided_steps", 0),
        "best_response_steps": pairs + starts * measured["steps"] + refits,
    }


def _totals(config: RunConfig) -> dict[str, int]:
    """Steps of each stage, in the units that its progress counts."""
    translator = config.translator
    return {
        "partners": config.partners.joint.num_updates,
        "best_responses": config.partners.refit_updates + config.partners.oracle.num_updates,
        "task_language": 1,
        "policy_vae": config.compression.fit.steps,
        "diffusion": config.diffusion.fit.steps,
        "translator": translator.fine_tuning.steps + translator.translation.steps,
        "universal": config.universal.training.num_updates,
    }
