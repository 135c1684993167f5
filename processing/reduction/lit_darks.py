"""Dark states that are not dark, and light states that are: the light was not shut off, or never let through.

Subtracted, such frames leave nothing, and nothing else shows it: every file is well formed and every state whole.
"""

import numpy as np
from numpy.typing import NDArray

from processing.storage.captures.capture import Capture

#: Part by which a light frame must rise above a dark one, both above the declared black level.
LEAST_CONTRAST = 0.1
#: Light states of a rotation among which there is a bright one; in a mosaic every frame holds all analyzers.
ENOUGH_STATES = 8
#: Noise is averaged over blocks of so many pixels a side before the brightest part is looked for.
BLOCK = 16
#: Standard deviations of a block's mean that are put down to noise.
NOISE_ALLOWANCE = 3.0
#: Part of the brightest light by which darks must be brighter than the lights of a block, and of blocks that must be.
LEAST_EXCESS, LEAST_AREA = 0.02, 0.01


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
        # A mosaic is looked at analyzer by analyzer: light of one polarization reaches some of them alone.
        self._step = 2 if mosaic else 1
        self._needed = 1 if mosaic else min(ENOUGH_STATES, lights)
        self._darks: dict[tuple[float, ...], tuple[NDArray[np.float64], float]] = {}
        self._suspects: dict[float, float] = {}
        self._seen: dict[float, int] = {}
        self._brightest: dict[float, float] = {}
        # Sum of the light frames' blocks, and their noise.
        self._total: dict[float, tuple[NDArray[np.float64], float]] = {}
        self._judged: set[float] = set()

    def dark(self, exposure_s: float, pose: tuple[float, ...], frame: NDArray[np.generic]) -> None:
        """Take a dark frame (rows, columns); `pose` are the target angles of its state."""
        if (exposure_s, *pose) not in self._darks:
            blocks = _blocks(frame, self._step) - self._black
            self._darks[exposure_s, *pose] = blocks, _block_noise(frame)

    def light(self, exposure_s: float, pose: tuple[float, ...], frame: NDArray[np.generic]) -> str | None:
        """Take a light frame; returns what is wrong with the darks of its exposure, None if nothing is (yet)."""
        if not any(key[0] == exposure_s for key in self._darks) or self._seen.get(exposure_s, 0) >= self._needed:
            return None
        blocks = _blocks(frame, self._step) - self._black
        self._seen[exposure_s] = self._seen.get(exposure_s, 0) + 1
        total, noise = self._total.get(exposure_s, (np.zeros_like(blocks), 0.0))
        self._total[exposure_s] = total + blocks, max(noise, _block_noise(frame))
        bright = _top(blocks)
        self._brightest[exposure_s] = max(bright, self._brightest.get(exposure_s, bright))
        dark = self._darks.get((exposure_s, *pose))
        if dark is not None:
            allowed = NOISE_ALLOWANCE * float(np.hypot(dark[1], _block_noise(frame)))
            if _top(blocks - dark[0]) <= LEAST_CONTRAST * max(bright, 0.0) + allowed:
                self._suspects.setdefault(exposure_s, _top(dark[0]) - allowed)
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

    def without_light(self, exposure_s: float) -> str | None:
        """Tell once that enough light states of an exposure were taken and their mean is no brighter than a dark."""
        count = self._seen.get(exposure_s, 0)
        if count < self._needed or exposure_s in self._judged:
            return None
        self._judged.add(exposure_s)
        total, noise = self._total[exposure_s]
        dark = next(dark for key, dark in self._darks.items() if key[0] == exposure_s)
        if _top(total / count - dark[0]) > NOISE_ALLOWANCE * float(np.hypot(dark[1], noise)):
            return None
        return f"the light states of {exposure_s:g} s are no brighter than the dark ones"


def resume_lit_darks(capture: Capture, lights: int) -> tuple[LitDarks, str | None]:
    """A comparison that has seen the states of a capture, of which `lights` will be light, and what it found."""
    header = capture.header
    look = LitDarks(header.detector.black_level_counts, mosaic=header.mosaic is not None, lights=lights)
    exposure_s, targets = capture.column("exposure_s"), capture.planned_targets_deg()

    def state(k: int) -> tuple[float, tuple[float, ...], NDArray[np.generic]]:
        # Of several cameras the first one serves.
        pose = tuple(float(angles[capture.done[k]]) for angles in targets.values())
        return float(exposure_s[k]), pose, capture.frames(k)[0]

    darks = capture.states_with("dark").tolist()
    for k in darks:
        look.dark(*state(k))
    for k, role in enumerate(capture.role if darks else ()):
        wrong = look.light(*state(k)) if role != "dark" else None
        if wrong is not None:
            return look, wrong
    return look, None


def leaked_light(capture: Capture) -> str | None:
    """A warning if the darks of a capture are brighter than its light states, or hold much of their light; else None.

    Compared are the darks of one exposure with light states of the same, `ENOUGH_STATES` of them evenly chosen.
    """
    exposure_s, header = capture.column("exposure_s"), capture.header
    darks = capture.states_with("dark")
    darks = darks[exposure_s[darks] == exposure_s[darks[0]]] if darks.size else darks
    lights = [k for k, role in enumerate(capture.role) if role != "dark" and exposure_s[k] in exposure_s[darks]]
    if not lights:
        return None
    step, black = 1 if header.mosaic is None else 2, header.detector.black_level_counts
    chosen = np.unique(np.linspace(0, len(lights) - 1, ENOUGH_STATES).round().astype(int))
    frame = capture.frames(int(darks[0]))[0]
    dark = _blocks(frame, step)
    light = np.max([_blocks(capture.frames(lights[k])[0], step) for k in chosen], axis=0)
    bright, level = _top(light) - black, float(np.median(dark)) - black
    least = max(LEAST_EXCESS * bright, 2 * NOISE_ALLOWANCE * _block_noise(frame))
    area = float(np.mean(dark - light > least))
    if area > LEAST_AREA:
        where = f"{100 * area:.0f} % of the image{' of single analyzers' if step > 1 else ''}"
        return (
            f"in {where} the dark states are brighter than the light states: light fell on the camera for them alone, "
            "and the signal is negative there"
        )
    # Without a declared black level nobody knows what of it is light.
    if black > 0 and level > LEAST_CONTRAST * bright:
        return (
            f"the dark states are {level:.0f} counts above the declared black level {black:g}, the brightest light "
            f"state {bright:.0f}: light leaks in, the dark current is large, or the declared level is wrong. What is "
            "not the same in every state is not taken out"
        )
    return None


def _blocks(frame: NDArray[np.generic], step: int) -> NDArray[np.float64]:
    """Means of blocks, of each analyzer by itself where they take turns every other pixel."""
    return np.concatenate([_block_means(frame[r::step, c::step]) for r in range(step) for c in range(step)])


def _block_means(frame: NDArray[np.generic]) -> NDArray[np.float64]:
    rows, columns = (max(1, size // BLOCK) for size in frame.shape)
    high, wide = min(BLOCK, frame.shape[0]), min(BLOCK, frame.shape[1])
    cut = frame[: rows * high, : columns * wide]
    return np.asarray(cut.reshape(rows, high, columns, wide).mean(axis=(1, 3)), dtype=np.float64).ravel()


def _block_noise(frame: NDArray[np.generic]) -> float:
    """Standard deviation of a block's mean, by neighbours of one kind in every eighth row; edges are no noise."""
    rows = np.asarray(frame[::8], dtype=np.float64)
    if rows.shape[1] < 3:
        return 0.0
    pixels = min(BLOCK, frame.shape[0]) * min(BLOCK, frame.shape[1])
    return float(1.4826 * np.median(np.abs(rows[:, 2:] - rows[:, :-2])) / np.sqrt(2 * pixels))


def _top(blocks: NDArray[np.float64]) -> float:
    return float(np.percentile(blocks, 99))
