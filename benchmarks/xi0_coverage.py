"""Do the intervals of xi0 hold for poor states too? Coverage by Monte Carlo: docs/studies/error-bars.md.

    python benchmarks/xi0_coverage.py [--pixels 4000]

An entry is the part of the truths, %, within the 68 and the 95 % interval: the least and the most of those of three
light levels where the mask says that xi0 can be known. Below them: the worst of twelve single processes; what holds
is the average over processes.
"""

from __future__ import annotations

import argparse

import numpy as np
from noisy_images import noisy_image, random_processes, state_tables

from processing.maps.xi0 import eigenvalue_block
from processing.polarization import triply_degenerate

ELECTRONS = (60.0, 1000.0, 20_000.0)
TRUTHS = (0.25, 0.3, 0.4, 0.6, 0.9)


def coverage(w: np.ndarray, processes: np.ndarray, truth: float, electrons: float) -> tuple[float, float] | None:
    """Part of the truths within the 68 and the 95 % interval; None where the mask leaves out pixels."""
    found = eigenvalue_block(noisy_image(triply_degenerate.mueller_matrix(processes, truth), electrons, 5, w))
    if not found["valid"].all():
        return None
    inside = [(found[name][0] <= truth) & (truth <= found[name][1]) for name in ("xi0_68", "xi0_95")]
    return float(np.mean(inside[0])), float(np.mean(inside[1]))


def _cell(w: np.ndarray, groups: list[np.ndarray], truth: float) -> str:
    found = [coverage(w, processes, truth, e) for e in ELECTRONS for processes in groups]
    known = [entry for entry in found if entry is not None]
    parts = [100 * np.array(column) for column in zip(*known, strict=True)]
    if len(groups) > 1:
        return ", ".join(f"{part.min():.0f}" for part in parts)
    return ", ".join(f"{part.min():.0f} to {part.max():.0f}" for part in parts)


def table(pixels: int) -> str:
    """The whole table in Markdown."""
    lines = [f"| states | condition | {' | '.join(f'xi0 = {t:g}' for t in TRUTHS)} |", "|---" * (2 + len(TRUTHS)) + "|"]
    single = [np.tile(one, (pixels, 1, 1)) for one in random_processes(12, 7)]
    for name, w in state_tables().items():
        for label, groups in ((name, [random_processes(pixels, 1)]), ("  worst of twelve processes", single)):
            cells = [_cell(w, groups, truth) for truth in TRUTHS]
            lines.append(f"| {label} | {np.linalg.cond(w):.0f} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=4000)
    print(table(parser.parse_args().pixels))
