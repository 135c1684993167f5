"""Figures and facts about each capture in the report of `diagnose --reflectance`."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.surface.diagnose import SurfaceJudged
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.quantities import dominant_errors, quantities
from processing.diagnosis.verdict.report import CaptureSection, write_diagnosis_report
from processing.reports.colours import SIGNED
from processing.reports.figure_style import png
from processing.reports.template import Figure


def write_surface_report(path: Path, judged: SurfaceJudged, problem: SurfaceProblem) -> None:
    """Write the report to a new file. Raises ProcessError if it exists."""
    d = judged.diagnosis
    material = f"Material {d.material}: " + ", ".join(f"{k} = {v:.4g}" for k, v in d.constants.items()) + "."
    write_diagnosis_report(path, d, [_capture(judged, problem, k) for k in range(len(d.captures))], material)


def _capture(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> CaptureSection:
    """Figures of one capture, its tests, and what the model says of it."""
    d, capture = judged.diagnosis, judged.diagnosis.captures[k]
    facts = [
        (f"{name}, before and after", f"{v:.1f}, {capture.tests_after[name]:.1f} standard deviations")
        for name, v in capture.tests_before.items()
    ]
    before, after = d.quantities_before[k], d.quantities_after[k]
    facts.append(("median xi0", f"{before.xi0:.4f}, {after.xi0:.4f}; rms change {d.xi0_change[k]:.4f}"))
    figures = [
        Figure(png(residual_figure(judged, problem, k)), "Residual and xi0, before and after"),
        Figure(png(states_figure(judged, problem, k)), "Residual of each state (and channel)"),
    ]
    if before.psi_deg is not None and after.psi_deg is not None:
        psi, size = f"{before.psi_deg:.2f}, {after.psi_deg:.2f}", (before.magnitude_percent, after.magnitude_percent)
        facts.append(("psi of m0, model - measured", f"{psi} degrees rms; noise alone {after.psi_noise_deg:.2f}"))
        facts.append(("|D| of m0", f"{size[0]:.2f}, {size[1]:.2f} % rms; {after.magnitude_noise_percent:.2f}"))
        caption = "Dominant process, model less measured, before and after"
        figures.append(Figure(png(dominant_figure(judged, problem, k)), caption))
    return CaptureSection(capture.name, figures, facts)


def residual_figure(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> Any:
    """Residual of each tile along its leading component, rms of each pixel, and xi0; before and after."""
    from matplotlib.figure import Figure as Picture

    data, pairs = problem.captures[k], judged.solution.ends
    first = problem.pixels(k, pairs[0][0], pairs[0][1].values).residual
    _, vectors = np.linalg.eigh(first.T @ first)
    figure = Picture(figsize=(11, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    scales: list[tuple[float, float]] = []
    for row, (space, fit) in enumerate(pairs):
        values = fit.values
        r = problem.pixels(k, space, values).residual
        smooth = np.array([r[data.tile == t].mean(axis=0) @ vectors[:, -1] for t in data.tile])
        xi0 = quantities(problem, k, space, values)[1]
        maps = (np.sqrt(np.mean(r**2, axis=1)), smooth, xi0)
        if not scales:
            top = float(np.nanpercentile(maps[0], 99.5))
            wide = float(np.nanmax(np.abs(smooth))) or 1.0
            scales = [(0.0, top), (-wide, wide), (0.25, float(np.nanpercentile(xi0, 99.5)))]
        names = ("rms residual / noise", "leading residual, mean of tiles / noise", "xi0")
        for axis, values_of, (low, high), name, colours in zip(
            axes[row], maps, scales, names, ("magma", SIGNED, "viridis"), strict=True
        ):
            drawn = axis.imshow(_image(data.where, data.shape, values_of), vmin=low, vmax=high, cmap=colours)
            figure.colorbar(drawn, ax=axis)
            axis.set_title(f"{name}, {'after' if row else 'before'}", fontsize=9)
            axis.set_axis_off()
    return figure


def states_figure(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> Any:
    """Rms residual of each row of W over the pixels, before and after."""
    from matplotlib.figure import Figure as Picture

    figure = Picture(figsize=(11, 2.6), layout="constrained")
    axis = figure.subplots()
    for name, (space, fit) in zip(("before", "after"), judged.solution.ends, strict=True):
        pixels = problem.pixels(k, space, fit.values)
        rms = np.sqrt(np.mean(pixels.residual**2, axis=0) / np.mean(pixels.free * problem.noise[k], axis=0))
        axis.plot(rms, "o-", ms=3, label=name)
    axis.axhline(1.0, color="0.6", lw=0.8)
    axis.set_ylim(bottom=0)
    axis.set_xlabel("state (and channel)")
    axis.set_ylabel("rms residual / noise")
    axis.legend()
    return figure


def dominant_figure(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> Any:
    """Modelled less measured psi and |D| of the dominant process, before and after, of a full Mueller capture."""
    from matplotlib.figure import Figure as Picture

    data = problem.captures[k]
    figure = Picture(figsize=(11, 2.9), layout="constrained")
    axes = figure.subplots(1, 4)
    names = (("psi / degree", 90.0), ("|D| / %", 50.0))
    for column, (space, fit) in enumerate(judged.solution.ends):
        errors = dominant_errors(problem, k, space, fit.values, y=data.y) or ()
        for row, ((name, wide), error) in enumerate(zip(names, errors, strict=False)):
            axis = axes[2 * row + column]
            drawn = axis.imshow(_image(data.where, data.shape, error), vmin=-wide, vmax=wide, cmap=SIGNED)
            figure.colorbar(drawn, ax=axis, shrink=0.8)
            axis.set_title(f"{name}, {'after' if column else 'before'}", fontsize=9)
            axis.set_axis_off()
    return figure


def _image(where: NDArray[np.int64], shape: tuple[int, int], values: Array) -> Array:
    low, high = where.min(axis=0), where.max(axis=0)
    step = max(int(np.min(np.diff(np.unique(where[:, 0])))), 1)
    size = (high - low) // step + 1
    image = np.full(tuple(size), np.nan)
    index = (where - low) // step
    image[index[:, 0], index[:, 1]] = values
    return image
