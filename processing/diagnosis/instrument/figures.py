"""Figures and facts about each capture in the report of a diagnosis of an instrument."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.diagnose import Judged
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import add_response
from processing.diagnosis.instrument.structure import HARMONICS, Residual, harmonics_of
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.range_of import rank_of
from processing.diagnosis.search.space import Space
from processing.diagnosis.verdict.report import CaptureSection, write_diagnosis_report
from processing.polarization.cloude import xi0_and_dominant
from processing.reports.colours import SIGNED, upper_end
from processing.reports.figure_style import clipped, png
from processing.reports.template import Figure as Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_report(path: Path, judged: Judged, problem: InstrumentProblem) -> None:
    """Write the report to a new file. Raises ProcessError if it exists."""
    captures = [_capture(judged, problem, k) for k in range(len(problem.captures))]
    write_diagnosis_report(path, judged.diagnosis, captures)


def _capture(judged: Judged, problem: InstrumentProblem, k: int) -> CaptureSection:
    """Title, figures and the change of the Mueller elements of one capture."""
    figures = (
        Picture(png(_pattern(judged, problem, k)), "Leading pattern of the residual"),
        Picture(png(_states(judged, k)), "Residual of each state"),
    )
    elements, note = _change(judged, problem, k) if judged.diagnosis.effects else ((), "")
    return CaptureSection(problem.captures[k].name, figures, elements=elements, note=note)


def _residuals(judged: Judged, k: int) -> dict[str, Residual]:
    """Residuals of a capture by the name of their curve; one where no cause was found."""
    if not judged.diagnosis.effects:
        return {"residual": judged.before[k]}
    after = "after" if judged.after is judged.explained else "with the causes (not applied)"
    return {"before": judged.before[k], after: judged.explained[k]}


def _pattern(judged: Judged, problem: InstrumentProblem, k: int) -> Figure:
    """The leading pattern of the residual before the correction, and its amplitude after it.

    The panels show the image, the states and the harmonics. They use means over squares of pixels, because the noise of
    single pixels hides the structure.
    """
    from matplotlib.figure import Figure

    residuals = _residuals(judged, k)
    names = tuple(residuals)
    cells = [cell_means(r.image) for r in residuals.values()]
    used = np.isfinite(cells).all(axis=(0, 1))
    flat = [image[:, used] for image in cells]
    values, vectors = np.linalg.eigh(flat[0] @ flat[0].T)
    leading, share = vectors[:, -1], values[-1] / max(values.sum(), 1e-300)
    maps = [np.tensordot(leading, image, 1) for image in cells]
    # The sign of an eigenvector is arbitrary: positive where most of the image is.
    if np.nansum(maps[0]) < 0:
        leading, maps = -leading, [-m for m in maps]
    where = leading @ flat[0]
    states = [f @ where / max(float(np.linalg.norm(where)), 1e-300) / max(where.size, 1) ** 0.5 for f in flat]
    figure = Figure(figsize=(11, 8.4), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.15, 1])
    upper, lower = halves
    wide = max(upper_end(np.abs(maps[0])), 1e-6)
    axes = upper.subplots(1, len(names), squeeze=False)[0]
    extent = _extent(judged.before[k].image)
    for axis, name, image in zip(axes, names, maps, strict=True):
        shown = axis.imshow(image, vmin=-wide, vmax=wide, cmap=SIGNED, extent=extent, aspect="equal")
        axis.set_title(name)
        axis.set_xlabel("column, pixels")
        axis.set_ylabel("row, pixels")
        axis.set_facecolor("0.85")
    upper.suptitle("leading pattern of the residual: its amplitude over the image")
    label, extend = "residual / noise of one intensity", clipped(maps[0], -wide, wide)
    upper.colorbar(shown, ax=axes, label=label, extend=extend, panchor=False)
    left, right = lower.subplots(1, 2, width_ratios=[1.6, 1])
    for line, name in zip(states, names, strict=True):
        left.plot(line, "o-", ms=3, label=name)
    left.axhline(0, color="0.5", lw=0.8)
    left.set_xlabel("state (and channel)")
    left.set_ylabel("residual / noise of one intensity")
    when = " before" if len(names) > 1 else ""
    left.set_title(f"the pattern over the states: {100 * share:.0f} % of the residual{when}")
    if len(names) > 1:
        left.legend()
    channels = problem.captures[k].signal.shape[1]
    orders = np.arange(1, HARMONICS + 1)
    turned = {name: v for name, v in problem.captures[k].conditions.angles_deg.items() if np.ptp(v) > 0}
    for n, (axis_name, angles) in enumerate(turned.items()):
        for line, name, alpha, shift in zip(states, names, (0.4, 1.0), (-0.2, 0.0), strict=False):
            # Of two channels the one that shows it best: in their mean a difference would be lost.
            parts = line.reshape(-1, channels)
            best = np.argmax(np.sum(states[0].reshape(-1, channels) ** 2, axis=0))
            heights = harmonics_of(parts[:, best], angles)
            right.bar(orders + 0.1 * n + shift, heights, 0.1, color=f"C{n}", alpha=alpha, label=f"{axis_name} {name}")
    right.set_xlabel("harmonic, periods a turn")
    right.set_ylabel("amplitude / noise of one intensity")
    right.set_title("its harmonics")
    right.set_xticks(orders)
    if turned:
        right.legend(fontsize=7)
    return figure


def _states(judged: Judged, k: int) -> Figure:
    """Residual of each state, of means over squares of pixels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.4), layout="constrained")
    axis = figure.subplots()
    for name, residual in _residuals(judged, k).items():
        rms = np.sqrt(np.nanmean(cell_means(residual.image) ** 2, axis=(1, 2)))
        axis.plot(rms, "o-", ms=3, label=name)
    side = _cell_side(judged.before[k].image)
    if (noise := noise_of_cells(judged.explained[k].image)) is not None:
        axis.axhline(noise, color="0.5", ls="--", label="noise")
    axis.set_xlabel("state (and channel)")
    axis.set_ylabel("rms residual / noise of one intensity")
    axis.set_title(f"each state, over squares of {side} x {side} pixels" if side > 1 else "each state, over the pixels")
    axis.set_ylim(bottom=0)
    axis.legend()
    return figure


def _cell_side(image: NDArray[np.floating]) -> int:
    """Side of the squares in pixels: about 40 along the longer side of an image."""
    return max(1, round(float(max(image.shape[1:])) / 40))


def _squares(image: NDArray[np.floating]) -> Array:
    """Values (L, rows, columns, N) of the pixels of each square."""
    side = _cell_side(image)
    height, width = (max(length // side, 1) for length in image.shape[1:])
    down, across = min(side, image.shape[1]), min(side, image.shape[2])
    parts = image[:, : height * down, : width * across].astype(float)
    parts = parts.reshape(len(image), height, down, width, across).swapaxes(2, 3)
    return parts.reshape(len(image), height, width, down * across)


def cell_means(image: NDArray[np.floating]) -> Array:
    """Means (L, rows, columns) over squares of pixels; NaN where less than half of the pixels are used."""
    values = _squares(image)
    number = np.isfinite(values).sum(axis=-1)
    means = np.nansum(values, axis=-1) / np.maximum(number, 1)
    return np.where(number >= max(values.shape[-1] / 2, 1), means, np.nan)


def noise_of_cells(image: NDArray[np.floating]) -> float | None:
    """Standard deviation of the mean over a square, from the scatter inside the squares; None of single pixels.

    The fit has taken its part of the noise away already.
    """
    values = _squares(image)
    full = values[np.isfinite(values).all(axis=-1)]
    number = values.shape[-1]
    if number == 1 or not full.size:
        return None
    return float(np.sqrt(full.var(axis=-1, ddof=1).mean() / number))


def _extent(image: NDArray[np.floating]) -> tuple[float, float, float, float]:
    side = _cell_side(image)
    height, width = (max(length // side, 1) * side for length in image.shape[1:])
    return -0.5, width - 0.5, height - 0.5, -0.5


def _change(judged: Judged, problem: InstrumentProblem, k: int) -> tuple[Sequence[Sequence[str]], str]:
    """Change of the Mueller elements, and of xi0, by the correction."""
    first, second = (_mueller(problem, k, space, fit) for space, fit in judged.solution.ends)
    if first is None or second is None:
        return (), "These states do not determine a Mueller matrix. The report gives no change of final quantities."
    difference = np.sqrt(np.mean((second - first) ** 2, axis=0)).reshape(4, 4)
    before, after = (xi0_and_dominant(m.reshape(-1, 4, 4))[0] for m in (first, second))
    return (
        [[""] * 4, *([f"{v:.5f}" for v in line] for line in difference)],
        f"Median xi0 {np.nanmedian(before):.5f} to {np.nanmedian(after):.5f}, rms change "
        f"{np.sqrt(np.nanmean((after - before) ** 2)):.5f}.",
    )


def _mueller(problem: InstrumentProblem, k: int, space: Space, fit: Fit) -> Array | None:
    problem, values = problem.near(space, fit.values)
    data = problem.captures[k]
    changes = problem.changes(k, space, values)
    w = data.matrix_of(problem.models[k], changes)
    if rank_of(w) < 16:
        return None
    rows, shape = w.shape[0], data.signal.shape[2:]
    y = data.signal.reshape(rows, *shape).astype(float)
    y = add_response(y, problem.coefficients(k, changes), problem.columns(k, changes)).reshape(rows, -1)
    m = (np.linalg.pinv(w) @ y[:, data.usable.reshape(-1)]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        m = m / m[:, :1]
    return np.asarray(m[np.isfinite(m).all(axis=1)])
