"""The figure at the end of a capture: does it look as it should, before anybody reduces it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.reduction.black import Black
from processing.reports.colours import upper_end
from processing.reports.figure_style import clipped
from processing.storage.captures.capture import Capture
from processing.whole_file import whole_file

#: Longest side of the maps in the figure, pixels; a larger frame is thinned out.
LARGEST = 600
#: Saturated part of a frame that the figure can bear.
HARDLY = 0.01


def draw(path: Path) -> Path:
    """Draw mean image, modulation and mean of each state of a capture; returns the PNG next to it.

    Modulation is (max - min) / (max + min) over the light states, without the dark; in a mosaic over the super-pixel.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with Capture(path) as capture:
        mean, modulation, levels, states = _maps(capture)
        header, simulated = capture.header, capture.simulated
    figure = Figure(figsize=(12, 4.2))
    FigureCanvasAgg(figure)
    # Places by hand: a layout engine would take as long as all of the drawing. The number at the top of a colour bar
    # must not meet the label of the next panel.
    left, middle, right = figure.subplots(1, 3)
    figure.subplots_adjust(left=0.01, right=0.985, bottom=0.13, top=0.84, wspace=0.2)
    for axes, image, title, limits in (
        (left, mean, "mean, counts above dark", (0.0, None)),
        (middle, modulation, "modulation", (0.0, upper_end(modulation))),
    ):
        mappable = axes.imshow(image, cmap="gray" if axes is left else "viridis", vmin=limits[0], vmax=limits[1])
        axes.set_title(title)
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(mappable, ax=axes, shrink=0.8, extend=clipped(image, *mappable.get_clim()))
    right.plot(states, levels, "o-", markersize=3, linewidth=0.8)
    right.set_xlabel("state")
    right.set_ylabel("frame mean, counts above dark")
    right.set_title("each state")
    title = header.title
    if simulated:
        figure.suptitle(f"SIMULATED   {title}", color="firebrick", weight="bold")
    else:
        figure.suptitle(title)
    target = path.with_name(path.name.removesuffix(".partial").removesuffix(".h5") + ".png")
    with whole_file(target, follow=False) as new:
        figure.savefig(new, dpi=110)
    return target


def _maps(capture: Capture) -> tuple[NDArray[np.float32], NDArray[np.float32], list[float], list[int]]:
    light = _best_exposure(capture)
    mosaic = capture.header.mosaic is not None
    step = max(1, -(-max(capture.frame_shape) // LARGEST))
    darks = Black.of(capture) or Black.level(capture.header.detector.black_level_counts)
    black = darks.at(float(capture.column("exposure_s")[light[0]]))[0] if light else np.zeros(())
    total = low = high = None
    levels = []
    for k in light:
        frame = capture.frames(k)[0].astype(np.float32) - black
        levels.append(float(frame.mean()))
        for image in _super_pixels(frame) if mosaic else [frame]:
            thin = image[::step, ::step]
            total = thin.copy() if total is None else total + thin
            low = thin if low is None else np.minimum(low, thin)
            high = thin if high is None else np.maximum(high, thin)
    if total is None or low is None or high is None:
        empty = np.zeros((1, 1), dtype=np.float32)
        return empty, empty, [], []
    mean = total / (len(light) * (4 if mosaic else 1))
    # Where there is hardly any light, noise alone would look like full modulation.
    lit = mean > 0.02 * float(np.percentile(mean, 99.5))
    sum_ = np.where(lit, high + low, 1.0)
    modulation = np.where(lit, np.clip((high - low) / np.where(sum_ > 0, sum_, 1.0), 0, 1), np.nan)
    return mean.astype(np.float32), modulation.astype(np.float32), levels, light


def _best_exposure(capture: Capture) -> list[int]:
    """States with light, of a bracket those of the longest exposure at which hardly anything is saturated."""
    light = np.flatnonzero([role != "dark" for role in capture.role])
    exposure_s, saturated = capture.column("exposure_s")[light], capture.column("saturated_fraction")[light]
    lengths = [length for length in np.unique(exposure_s) if saturated[exposure_s == length].max(initial=0) < HARDLY]
    return [int(k) for k in light[exposure_s == (lengths[-1] if lengths else exposure_s.min(initial=np.inf))]]


def _super_pixels(frame: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    rows, columns = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
    return [frame[r:rows:2, c:columns:2] for r in (0, 1) for c in (0, 1)]
