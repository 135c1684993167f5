"""Frames of a capture for `diagnose`: above black, split by polarizer, averaged over squares of pixels as they come.

Only one frame is there as stored, so a large sensor takes no more memory than what is kept of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.diagnosis.captured.squares import means, side_for, squares
from processing.diagnosis.search.rules import BELOW_WELL, CUT_OFF, FEW_PIXELS, MANY_VALUES, MOST_READ
from processing.instrument.model import InstrumentModel
from processing.reduction.counts_to_signal import Correction
from processing.storage.captures.capture import Capture


@dataclass(frozen=True)
class Frames:
    """What was read.

    Attributes
    ----------
    counts : (N, channels, rows, columns) above black, means over squares of `side` pixels of a channel.
    top : largest count above black before averaging.
    clipped : (rows, columns) some pixel of the square is at the top of the range in some state.
    clipped_states : (N,) in which some pixel is.
    zero : (N, rows, columns) some pixel of the square is cut off at zero; zero_share : (N,) share of the pixels.
    """

    counts: NDArray[np.float32]
    top: float
    clipped: NDArray[np.bool_]
    clipped_states: NDArray[np.bool_]
    zero: NDArray[np.bool_]
    zero_share: NDArray[np.float64]
    side: int


def read_frames(capture: Capture, model: InstrumentModel, states: NDArray[np.int64], correction: Correction) -> Frames:
    """Read some states of a capture one after the other, as `model` sees them."""
    split = _Split(model)
    exposure = capture.column("exposure_s")[states].astype(float)
    level, has_zero = _clip_level(capture, correction), _cuts_off(capture)
    counts: list[NDArray[np.float32]] = []
    clipped: list[NDArray[np.bool_]] = []
    zero: list[NDArray[np.bool_]] = []
    share, tops, side = np.zeros(len(states)), [], 1
    for n, k in enumerate(states):
        frame = capture.frames(int(k)).astype(np.float32)
        over = split.any_of(frame >= (np.inf if level is None else level))
        under = split.any_of((frame <= 0) & has_zero)
        frame -= correction.black.at(exposure[n])
        planes = split.planes(frame if correction.flat is None else frame / correction.flat.response)
        side = _side(len(states) * len(planes), *planes.shape[1:])
        tops.append(float(planes.max(initial=-np.inf, where=np.isfinite(planes))))
        share[n] = under.mean()
        counts.append(means(planes, side))
        clipped.append(np.asarray(squares(over, side).any(axis=(-3, -1))))
        zero.append(np.asarray(squares(under, side).any(axis=(-3, -1))))
    over_states = np.stack(clipped)
    return Frames(
        counts=np.stack(counts),
        top=max(tops),
        clipped=np.asarray(over_states.any(axis=0)),
        clipped_states=np.asarray(over_states.any(axis=(1, 2))),
        zero=np.stack(zero),
        zero_share=share,
        side=side,
    )


class _Split:
    """The pixels of a mosaic apart by polarizer; a sensor without one is as it is."""

    def __init__(self, model: InstrumentModel) -> None:
        self._channels, self._mosaic = [c.name for c in model.channels], model.mosaic

    def planes(self, frame: NDArray[np.float32]) -> NDArray[np.float32]:
        """Frames (channels, rows, columns) of stored ones, which are one with a mosaic."""
        if self._mosaic is None:
            return frame
        cells = self._cells(frame[0])
        where = {name: (r, c) for r, line in enumerate(self._mosaic) for c, name in enumerate(line)}
        return np.stack([cells[:, where[name][0], :, where[name][1]] for name in self._channels])

    def any_of(self, stored: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """True (rows, columns) where it is in some channel, or some pixel of a cell, of stored frames."""
        mask = np.asarray(stored.any(axis=0))
        return mask if self._mosaic is None else np.asarray(self._cells(mask).any(axis=(1, 3)))

    def _cells(self, image: NDArray[np.generic]) -> NDArray[np.generic]:
        assert self._mosaic is not None
        rows, columns = len(self._mosaic), len(self._mosaic[0])
        height, width = image.shape[0] // rows, image.shape[1] // columns
        return image[: height * rows, : width * columns].reshape(height, rows, width, columns)


def _side(values: int, height: int, width: int) -> int:
    """Side of the squares of pixels that are averaged, of images with so many values in each pixel."""
    side = side_for(values * height * width, MOST_READ)
    if values > MANY_VALUES:
        side = max(side, int(np.ceil(np.sqrt(height * width / FEW_PIXELS))))
    return side


def _cuts_off(capture: Capture) -> bool:
    """Whether noise cannot reach zero counts, so that they mean a black level that is too low."""
    detector = capture.header.detector
    if not capture.integer_counts or detector.gain_e_per_count is None:
        return False
    return detector.black_level_counts > CUT_OFF * (detector.read_noise_e or 0.0) / detector.gain_e_per_count


def _clip_level(capture: Capture, correction: Correction) -> float | None:
    detector, level = capture.header.detector, correction.saturation
    if detector.full_well_e is not None and detector.gain_e_per_count is not None:
        well = detector.black_level_counts + detector.full_well_e / detector.gain_e_per_count
        spread = BELOW_WELL * (detector.read_noise_e or 0.0) / detector.gain_e_per_count
        level = well - spread if level is None else min(level, well - spread)
    return level
