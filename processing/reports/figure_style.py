"""Style of figures: panels of maps, colour maps for angles, and the mark of simulated data."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.reports import colours

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Longest side of a panel in pixels; larger images are thinned before drawing, which changes no file.
PANEL_PIXELS = 600
#: Most pixels that the Poincare sphere shows.
SPHERE_PIXELS = 3000
SIMULATED = "SIMULATED"
PAGE_DPI = 100
#: Orientation is drawn in grey where its standard error is above this: it is not known there.
WORST_ORIENTATION_DEG = 20.0
#: Keywords of `imshow` for orientations.
CYCLIC = {"cmap": colours.CYCLIC, "vmin": 0, "vmax": 180}


def map_figure(panels: Sequence[tuple[str, NDArray[Any], dict[str, Any]]], title: str, simulated: bool) -> Figure:
    """Maps side by side; each is (label, values (rows, columns), keywords of imshow such as cmap, vmin, vmax)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(0.6 + 4.3 * len(panels), 4.2), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (label, values, keywords) in zip(axes, panels, strict=True):
        _map(figure, axis, values, label, **keywords)
    entitle(figure, title, simulated)
    return figure


def grid_figure(
    panels: Sequence[tuple[str, NDArray[Any], dict[str, Any]]],
    title: str,
    simulated: bool,
    columns: int = 4,
    *,
    sphere: NDArray[np.floating] | None = None,
) -> Figure:
    """Maps in rows of `columns`, as in `map_figure`; where no `vmax` is given it is the 99.5th percentile.

    `sphere` (3, n): Stokes vectors over S0, for a last panel with the Poincare sphere.
    """
    from matplotlib.figure import Figure

    shape = panels[0][1].shape
    rows = -(-(len(panels) + (sphere is not None)) // columns)
    high = 0.5 + 3.6 * max(0.4, shape[0] / max(shape[1], 1))
    figure = Figure(figsize=(4.25 * min(columns, len(panels)), 0.6 + rows * high), layout="constrained")
    axes = figure.subplots(rows, min(columns, len(panels)), squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    for axis, (label, values, keywords) in zip(axes.flat, panels, strict=False):
        _map(figure, axis, values, label, **({"vmax": max(percentile(values, 99.5), 1e-30)} | keywords))
    if sphere is not None:
        _poincare(figure.add_subplot(axes.flat[len(panels)].get_subplotspec(), projection="3d"), sphere)
    entitle(figure, title, simulated)
    return figure


def png(figure: Figure) -> bytes:
    """A figure as a PNG for a page."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=PAGE_DPI)
    return buffer.getvalue()


def thin(image: NDArray[Any]) -> NDArray[Any]:
    """Every k-th row and column, so that the longer side is at most PANEL_PIXELS."""
    step = max(1, -(-max(image.shape[-2:]) // PANEL_PIXELS))
    return image[..., ::step, ::step]


def _map(figure: Figure, axis: Any, values: NDArray[Any], label: str, **keywords: Any) -> None:
    shown = axis.imshow(values, interpolation="nearest", **keywords)
    axis.set_title(label, fontsize=10)
    axis.set_facecolor("0.85")
    axis.xaxis.set_visible(False)
    axis.yaxis.set_visible(False)
    figure.colorbar(shown, ax=axis, shrink=0.85, extend=clipped(values, *shown.get_clim()))


def _poincare(axis: Any, stokes: NDArray[np.floating]) -> None:
    """Pixels (3, n) inside the Poincare sphere: full polarization lies on its surface, none at its centre."""
    pixels = stokes[:, np.isfinite(stokes).all(axis=0)]
    pixels = pixels[:, :: max(1, pixels.shape[1] // SPHERE_PIXELS)]
    turn, height = np.linspace(0, 2 * np.pi, 73), np.linspace(-np.pi / 2, np.pi / 2, 13)
    round_ = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    for angle in height[2:-1:2]:
        axis.plot(*(round_ * np.cos(angle) + [[0], [0], [np.sin(angle)]]), color="0.8", linewidth=0.5)
    for angle in turn[:36:6]:
        axis.plot(np.cos(turn) * np.cos(angle), np.cos(turn) * np.sin(angle), np.sin(turn), color="0.8", linewidth=0.5)
    axis.plot(*round_, color="0.4", linewidth=0.8)
    for k in range(3):
        line = np.zeros((3, 2))
        line[k] = (0, 1.25)
        axis.plot(*line, color="black", linewidth=0.8)
        axis.text(*line[:, 1] * 1.08, f"$S_{k + 1}/S_0$", fontsize=8, ha="center")
    axis.scatter(*pixels, s=3, c="tab:red", depthshade=False, linewidths=0)
    axis.set_title("Poincaré sphere", fontsize=10)
    axis.set_box_aspect((1, 1, 1))
    axis.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
    axis.view_init(elev=20, azim=30)
    axis.set_axis_off()


def clipped(values: NDArray[Any], low: float, high: float) -> str:
    """Which ends of a colour bar get an arrow because there are values beyond them: matplotlib's `extend`."""
    finite = values[np.isfinite(values)]
    ends = (bool(np.any(finite < low)), bool(np.any(finite > high)))
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[ends]


def entitle(figure: Figure, title: str, simulated: bool) -> None:
    """Put the title on a figure; simulated data are marked in red."""
    figure.suptitle(
        f"{SIMULATED}   {title}" if simulated else title, color="darkred" if simulated else "black", fontsize=11
    )


def percentile(values: NDArray[Any], percent: float) -> float:
    """Percentile of the finite values; 1 where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if finite.size else 1.0
