"""How all figures look: type, colours that survive a grey print, and how names are shown."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.summary import HEADLINE, ORACLE, UNIVERSAL, UNIVERSAL_WITH_LABEL, WRONG

DOTS_PER_INCH = 150
TARGET = 0.95
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "hatch.linewidth": 0.6,
    "pdf.fonttype": 42,
}
# Colours that differ in lightness as well, so that they survive a grey print.
FILLS = {
    ORACLE: ("#575757", ""),
    "Best response": ("#8a8a8a", ""),
    "VAE reconstruction": ("#b8b8b8", ""),
    "Diffusion, true task language": ("#e2e2e2", ""),
    "Haland, training sentences": ("#8fc1e3", ""),
    HEADLINE: ("#2a6cb6", ""),
    WRONG: ("#ffffff", "////"),
    "General Ego": ("#e8b96a", ""),
    "Instructed Ego": ("#b5651d", ""),
    "Adaptive Ego": ("#f6e3c0", ".."),
    "General Ego (MLP)": ("#c9d8c0", "xx"),
    "Instructed Ego (MLP)": ("#6f8f6b", "//"),
    "Self-play": ("#dccfe6", ""),
    "FCP": ("#8d6fa6", ""),
    "CGAN (MLP)": ("#cfe8e6", ""),
    "CGAN (UNet)": ("#5fa8a3", ""),
    "Without translator": ("#cfe8e6", "xx"),
    "Without VAE": ("#2f6f6b", ""),
    "Without VAE (clean)": ("#2f6f6b", "//"),
    "Without fine-tuning": ("#5fa8a3", "//"),
    UNIVERSAL: ("#c9d8c0", ""),
    UNIVERSAL_WITH_LABEL: ("#6f8f6b", ""),
}
OTHER_FILLS = (
    ("#f3d6d6", ""),
    ("#b54a4a", ""),
    ("#f3d6d6", "oo"),
    ("#7d2e2e", ""),
)
"""Of methods that are not ours."""


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Writes `<name>.png` and `<name>.pdf`; returns the PNG."""
    figure.savefig(folder / f"{name}.png", dpi=DOTS_PER_INCH)
    figure.set_layout_engine("none")  # found already; the PDF has the same
    figure.savefig(folder / f"{name}.pdf", metadata={"CreationDate": None})
    return folder / f"{name}.png"


def fills_of(methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    others = [name for name in methods if name not in FILLS]
    extra = {name: OTHER_FILLS[i % len(OTHER_FILLS)] for i, name in enumerate(others)}
    return {name: FILLS.get(name) or extra[name] for name in methods}


def new_figure(width: float, height: float) -> Figure:
    """A figure, in inches, that no interactive session knows of."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def label_styles(axes: Axes, styles: Sequence[str]) -> None:
    axes.set_xticks(range(len(styles)), [words(style) for style in styles])
    for label in axes.get_xticklabels():
        label.set(rotation=40, ha="right", rotation_mode="anchor")


def draw_cell_borders(axes: Axes, rows: int, columns: int) -> None:
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=0.8)
    axes.tick_params(which="both", length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def words(name: str) -> str:
    return name.replace("_", " ").replace("@", " @ ")


def wrap(name: str) -> str:
    """A style's name on as many lines as it needs under a group of bars."""
    lines = [""]
    for word in name.split("_"):
        if lines[-1] and len(lines[-1]) + len(word) >= 14:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
