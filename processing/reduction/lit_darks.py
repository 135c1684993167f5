"""Dark states that are not dark: the light was not shut off while they were taken.

Subtracted, such frames leave nothing, and nothing else shows it: every file is well formed and every state whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.storage.capture import Capture

#: Part by which a light frame must rise above a dark one, both above the declared black level.
LEAST_CONTRAST = 0.1
#: Light states of a rotation among which there is a bright one; in a mosaic every frame holds all analyzers.
ENOUGH_STATES = 8
#: Noise is averaged over blocks of so many pixels a side before the brightest part is looked for.
BLOCK = 16


class LitDarks:
    """Compares dark frames with light frames of the same pose and exposure, as they come.

    The first light state may be dark by itself (crossed polarizers), so the brightest light frame decides in the end.

    Parameters
    ----------
    black_level : counts without light, as declared.
    mosaic : True for a polarization sensor.
    lights : number of light states of the capture.
    """

    def __init__(self, black_level: float, *, mosaic: bool, lights: int) -> None:
        self._black = black_level
        self._needed = 1 if mosaic else min(ENOUGH_STATES, lights)
        self._darks: dict[tuple[float, ...], NDArray[np.float64]] = {}
        self._suspects: dict[float, float] = {}
        self._seen: dict[float, int] = {}
        self._brightest: dict[float, float] = {}

    def dark(self, exposure_s: float, pose: tuple[float, ...], frame: NDArray[np.generic]) -> None:
        """Take a dark frame (rows, columns); `pose` are the target angles of its state."""
        self._darks.setdefault((exposure_s, *pose), _blocks(frame) - self._black)

    def light(self, exposure_s: float, pose: tuple[float, ...], frame: NDArray[np.generic]) -> str | None:
        """Take a light frame; returns what is wrong with the darks of its exposure, None if nothing is (yet)."""
        if not any(key[0] == exposure_s for key in self._darks) or self._seen.get(exposure_s, 0) >= self._needed:
            return None
        blocks = _blocks(frame) - self._black
        self._seen[exposure_s] = self._seen.get(exposure_s, 0) + 1
        bright = _top(blocks)
        self._brightest[exposure_s] = max(bright, self._brightest.get(exposure_s, bright))
        dark = self._darks.get((exposure_s, *pose))
        if dark is not None and _top(blocks - dark) <= LEAST_CONTRAST * max(bright, 0.0):
            self._suspects.setdefault(exposure_s, _top(dark))
        suspect = self._suspects.get(exposure_s)
        if suspect is None or self._seen[exposure_s] < self._needed:
            return None
        if suspect <= LEAST_CONTRAST * self._brightest[exposure_s]:
            return None
        brightest = self._brightest[exposure_s]
        return (
            f"the dark states of {exposure_s:g} s are as bright as a light state in the same pose: {suspect:.0f} "
            f"counts above the declared black level {self._black:g}, the brightest light state {brightest:.0f}"
        )


def lit_darks(capture: Capture) -> str | None:
    """What is wrong with the darks of a capture; None if nothing is, or if it has none."""
    darks = capture.states_with("dark")
    lights = [k for k, role in enumerate(capture.role) if role != "dark"]
    if darks.size == 0 or not lights:
        return None
    header = capture.header
    look = LitDarks(header.detector.black_level_counts, mosaic=header.mosaic is not None, lights=len(lights))
    exposure_s, targets = capture.column("exposure_s"), capture.planned_targets_deg()

    def state(k: int) -> tuple[float, tuple[float, ...], NDArray[np.generic]]:
        # Of several cameras the first one serves.
        pose = tuple(float(angles[capture.done[k]]) for angles in targets.values())
        return float(exposure_s[k]), pose, capture.frames(k)[0]

    for k in darks.tolist():
        look.dark(*state(k))
    for k in lights:
        wrong = look.light(*state(k))
        if wrong is not None:
            return wrong
    return None


def _blocks(frame: NDArray[np.generic]) -> NDArray[np.float64]:
    rows, columns = (max(1, size // BLOCK) for size in frame.shape)
    high, wide = min(BLOCK, frame.shape[0]), min(BLOCK, frame.shape[1])
    cut = frame[: rows * high, : columns * wide]
    return np.asarray(cut.reshape(rows, high, columns, wide).mean(axis=(1, 3)), dtype=np.float64)


def _top(blocks: NDArray[np.float64]) -> float:
    return float(np.percentile(blocks, 99))
