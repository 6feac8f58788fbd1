"""A results.json as a run would write it, with invented numbers."""

from typing import Any

import numpy as np

STYLES = [
    "left_no_onion",
    "left_no_dish",
    "left_no_onion_no_dish",
    "left_no_delivery",
    "right_no_onion",
    "right_no_dish",
    "right_no_onion_no_dish",
    "right_no_delivery",
]
SHARES = {
    "Best response": 0.96,
    "VAE reconstruction": 0.95,
    "Diffusion, true task language": 0.94,
    "Haland, training sentences": 0.94,
    "Haland, test sentences": 0.92,
    "Haland, wrong sentence": 0.35,
}
UNIVERSAL_SHARES = {"Universal ego": 0.7, "Universal ego with the style's label": 0.78}


def made_up_results(others: tuple[str, ...] = ()) -> dict[str, Any]:
    """Two held-out seeds and four episodes a partner; `others` adds further methods."""
    random = np.random.default_rng(0)
    oracle = {style: (150 + 60 * random.random(2)).tolist() for style in STYLES}

    def method(share: float) -> dict[str, Any]:
        return {
            style: {
                "returns": [
                    (seed * share + 8 * random.normal(size=4)).tolist() for seed in oracle[style]
                ]
            }
            for style in STYLES
        }

    methods = {name: method(share) for name, share in (SHARES | UNIVERSAL_SHARES).items()}
    methods |= {name: method(0.8 * random.random()) for name in others}
    events = [
        f"{player}:{event}"
        for player in ("ego", "partner")
        for event in (
            *(f"pickup_{item}@{place}" for item in ("onion", "dish") for place in ("left", "top")),
            *(f"put_{item}_on_counter@{place}" for item in ("onion", "soup") for place in (1, 2)),
            "pot_onion@pot_1", "start_cooking@pot_1", "take_soup@pot_1", "deliver_soup@serving_1",
            "steps@left_third", "steps@right_third",
        )
    ]  # fmt: skip
    steps = np.linspace(0, 1.2e6, 40)
    rise = 180 / (1 + np.exp(-(steps - 5e5) / 1.2e5))
    return {
        "environment": "overcooked/diverse_coordination",
        "preset": "quick",
        "seed": 0,
        "styles": STYLES,
        "methods": methods,
        "oracle": oracle,
        "upper_bounds": dict.fromkeys(STYLES, 240.0),
        "gates": {
            "best responses on held-out partners": {"value": 0.96, "bar": 0.9, "met": True},
            "VAE reconstruction, worst policy": {"value": 0.93, "bar": 0.95, "met": False},
        },
        "translator": {
            "accuracy": 30 / 32,
            "by_style": {style: 1.0 if index else 0.5 for index, style in enumerate(STYLES)},
        },
        "times": {"partners": 412.3, "policy_vae": 61.0, "diffusion": 48.2, "translator": 35.5},
        "machine": {"processor": "two cores", "backend": "cpu", "jax": "0.9.2"},
        "curves": {
            "steps": steps.tolist(),
            "returns": {
                style: [(rise * (0.8 + 0.2 * random.random())).tolist() for _ in range(4)]
                for style in STYLES
            },
        },
        "task_language": {"events": events, "v_hat": random.random((8, len(events))).tolist()},
        "cross_play": (60 + 60 * random.random((8, 8)) + 60 * np.eye(8)).tolist(),
        "universal": {"steps": 1_500_000, "seeds": 1, "best_response_steps": 52_800_000},
        "memorisation": {"nearest training latent distance": 3.2, "between training latents": 7.9},
    }
