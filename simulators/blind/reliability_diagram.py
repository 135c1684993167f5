"""Reliability diagram: the true share of the causes, against their reported probability."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simulators.blind.bench_judge import BenchJudgement
from simulators.blind.bench_table import reliability


def draw(judgements: Sequence[BenchJudgement], path: Path) -> None:
    """Write the diagram; bars are one standard error of a share (Wilson's interval), numbers count the causes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5, 4.5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="calibrated")
    lowest = 1.0
    for b in reliability(judgements):
        n, p = b.count, b.true
        middle, half = (p + 0.5 / n) / (1 + 1 / n), np.sqrt(p * (1 - p) / n + 0.25 / n**2) / (1 + 1 / n)
        axes.errorbar(b.told, middle, yerr=half, marker="o", color="C0", capsize=3)
        lowest = min(lowest, b.told, middle - half)
        axes.annotate(f"{n} ", (b.told, middle - half), ha="right", va="top", fontsize=8)
    # Reported causes rarely are less likely than nine in ten: an axis from zero would show one corner alone.
    least, room = np.floor(20 * lowest - 1) / 20, 0.02 * (1 - lowest)
    axes.set(xlabel="probability told", ylabel="share that is true", aspect="equal")
    axes.set(xlim=(least, 1 + room), ylim=(least, 1 + room))
    axes.legend(loc="upper left", frameon=False)
    figure.savefig(path, dpi=150)
