"""The demo in one figure: errors of M before and after, the residual over the states, and the causes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from acquisition.demo.loop import Demo
from acquisition.demo.summary import cause_rows, figure_rows
from acquisition.demo.truth import BLOCK
from processing.diagnosis.instrument.structure import Residual
from processing.reports.colours import SIGNED
from processing.reports.figure_style import SIMULATED

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

BEFORE, AFTER = "#b2182b", "#2166ac"
#: Percentile of the errors before at which the colours end.
END_PERCENT = 98.0


def draw(demo: Demo, path: Path) -> Path:
    """Write the figure as PNG."""
    figure = demo_figure(demo)
    figure.savefig(path, dpi=130)
    return path


def demo_figure(demo: Demo) -> Figure:
    """Maps above, residual of each state below on the left, causes below on the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 8), layout="constrained", facecolor="white")
    kinds = " and ".join(fault.kind.replace("_", " ") for fault in demo.faults)
    figure.suptitle(
        f"{SIMULATED}   undeclared: {kinds}   (./lab demo --seed {demo.seed})", color="darkred", fontsize=11
    )
    parts: Any = figure.subfigures(2, 1, height_ratios=[1.5, 1], hspace=0.02)
    lower: Any = parts[1].subfigures(1, 2, width_ratios=[1, 1.3])
    _maps(parts[0], demo)
    _states(lower[0], demo)
    _causes(lower[1], demo)
    return figure


def _maps(part: SubFigure, demo: Demo) -> None:
    """Errors of M / m00 on one scale: 4 x 4 maps with the declared instrument, and with the corrected one."""
    mosaics = [_mosaic(e.mueller) for e in (demo.before, demo.after)]
    end = float(np.nanpercentile(np.abs(mosaics[0]), END_PERCENT))
    axes = part.subplots(1, 2)
    image: Any = None
    for axis, mosaic, error, stage, colour in zip(
        axes, mosaics, (demo.before, demo.after), ("before", "after"), (BEFORE, AFTER), strict=True
    ):
        image = axis.imshow(mosaic, cmap=SIGNED, vmin=-end, vmax=end, interpolation="nearest")
        axis.set_title(
            f"Mueller matrix {stage} the correction: rms error {error.mueller_rms:.4f}", fontsize=10, color=colour
        )
        height, width = (n / 4 for n in mosaic.shape)
        for row, column in np.ndindex(4, 4):
            axis.text(column * width, row * height, f"M{row}{column}", fontsize=7.5, color="0.3", va="top")
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[:].set_visible(False)
    part.colorbar(
        image, ax=axes, shrink=0.9, aspect=28, extend="both", label=f"error of M/m00, means of {BLOCK} x {BLOCK} pixels"
    )


def _mosaic(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4, rows, columns) as one image, cropped to the object, with a gap around each element."""
    valid = np.isfinite(error[0, 1])
    rows, columns = (np.flatnonzero(valid.any(axis=a)) for a in (1, 0))
    cut = error[..., rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    padded = np.pad(cut, ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    return np.concatenate([np.concatenate(list(line), axis=1) for line in padded], axis=0)


def _states(part: SubFigure, demo: Demo) -> None:
    """Residual of each state of both captures, in means over blocks, so that photon noise does not hide it."""
    axes = part.subplots(1, 2)
    for axis, before, after, name in zip(axes, demo.judged.before, demo.judged.after, ("sphere", "air"), strict=True):
        axis.plot(block_rms(before), "o-", ms=2.8, lw=0.9, color=BEFORE, label="before")
        axis.plot(block_rms(after), "o-", ms=2.8, lw=0.9, color=AFTER, label="after")
        axis.set_title(f"residual, {name}", fontsize=9)
        axis.set_xlabel("state", fontsize=8)
        axis.tick_params(labelsize=7.5)
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_ylim(bottom=0)
    axes[0].set_ylabel("residual / noise", fontsize=8)
    part.legend(*axes[0].get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside lower center", ncols=2)


def block_rms(residual: Residual) -> NDArray[np.float64]:
    """Rms (L,) of means of the residual over blocks of the image, in units of the noise of these means."""
    image = residual.image.astype(float)
    rows, columns = (n // BLOCK for n in image.shape[1:])
    cut = image[:, : rows * BLOCK, : columns * BLOCK].reshape(-1, rows, BLOCK, columns, BLOCK)
    counted = np.isfinite(cut).sum(axis=(2, 4))
    sums = np.nansum(cut, axis=(2, 4)) / np.sqrt(np.maximum(counted, 1))
    # Only whole blocks: the rim of the object is another matter.
    sums[counted < BLOCK**2] = np.nan
    return np.asarray(np.sqrt(np.nanmean(sums**2, axis=(1, 2))))


def _causes(part: SubFigure, demo: Demo) -> None:
    """True faults and the effect found for each, then the figures before and after."""
    axis = part.subplots()
    axis.set_axis_off()
    lines: list[tuple[tuple[str, ...], str]] = []
    for fault, effect in cause_rows(demo):
        lines += [(("built in", fault), "black"), (("found", effect), AFTER), ((), "")]
    lines.append((("", "before", "after", "photon noise"), "0.4"))
    lines += [(row, "black") for row in figure_rows(demo)]
    step = min(0.085, 1.0 / len(lines))
    for k, (words, colour) in enumerate(lines):
        places = (0.0, 0.13) if len(words) == 2 else (0.0, 0.36, 0.62, 0.84)
        for x, word in zip(places, words, strict=False):
            text = axis.text(x, 1 - k * step, word, fontsize=8, va="top", color=colour, transform=axis.transAxes)
            # Else a long line would shrink the rest.
            text.set_in_layout(False)
