"""Figures from results.json: those of one run, and the paper's from several runs."""

from experiments.figures.of_run import draw_figures as draw_figures
