"""The noise that a capture is judged with: as declared, unless its own images show another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.black_jitter import black_jitter
from processing.diagnosis.captured.capture_data import CaptureData, SharedNoise
from processing.diagnosis.captured.detector_noise import DetectorNoise, detector_noise
from processing.diagnosis.search.rules import (
    AS_GOOD,
    DARK_NOISE_OFF,
    LEAST_DARK,
    LEAST_LIT,
    NOISE_ALIKE,
    NOISE_OFF,
    NOISE_OFF_MIXED,
    NOISE_SURE,
)

#: [1] Largest factor on the gain that is tried, and one over the least.
MOST_GAIN = 10.0
#: [factors] On the gain that are tried: steps of a percent.
GAINS = 400
#: [1] Least factor on the variance without light that is tried.
LEAST_DARK_FACTOR = 0.01
#: [1] Largest factor on the variance without light that is tried.
MOST_DARK_FACTOR = 400.0
#: [factors] On the variance without light that are tried: steps of a percent.
DARKS = 800


def checked_noise(data: CaptureData, a: Array) -> CaptureData:
    """The capture with the noise that its images show against rows a (L, K) of its model, and what is to be told.

    A black level that jitters is taken off, as far as it shows.
    """
    told: list[str] = []
    jitter = black_jitter(data, a) if data.noise_known else None
    if jitter is not None:
        offsets, variance = jitter
        told.append(_in_counts("the black level is another one in every frame", variance, data))
        level = offsets.reshape(*data.signal.shape[:2], 1, 1)
        data = replace(data, signal=(data.signal - level).astype(np.float32))
    found = detector_noise(data, a) if data.noise_known else None
    if found is None:
        return replace(data, noise_told=tuple(told))
    shared = _mixed(found)
    if shared.shown < 1:
        told.append(
            f"neighbours share noise (correlation {found.right:.2f} across, {found.down:.2f} down): the images were "
            f"resampled or smoothed, and of {1 / shared.shown:.1f} pixels one is independent"
        )
    if max(found.rows, found.columns) > NOISE_SURE * found.rows_error:
        shared = _with_lines(shared, found, data)
    lines = _lines(shared, data)
    for name, part in zip(("row", "column"), lines, strict=True):
        if part > 0:
            told.append(_in_counts(f"every {name} of a frame has an offset of its own", part, data))
    shot, dark = factors = noise_factors(found, shared.shown, data.noise_estimated)
    white = None
    if not data.noise_estimated and factors != (1.0, 1.0):
        white = _white_in_words(data, found.white / shared.shown, shot, dark)
    # What is common to a line is a part of the variance of its pixels, and more of that of wide patterns.
    slope, floor = data.slope * shot * shared.wide, (data.floor * dark + sum(lines)) * shared.wide
    return replace(
        data, slope=slope, floor=floor, shared=shared, noise_factors=factors, noise_told=tuple(told), white_told=white
    )


def _in_counts(what: str, variance: float, data: CaptureData) -> str:
    return f"{what}, {np.sqrt(variance) * data.conditions.full_scale:.2g} counts rms"


def _mixed(found: DetectorNoise) -> SharedNoise:
    least = max(NOISE_ALIKE, NOISE_SURE * found.alike_error)
    return SharedNoise(*(_part(alike) if alike > least else 0.0 for alike in (found.right, found.down)))


def _part(alike: float) -> float:
    """Part of the next pixel that was mixed in, from the correlation of neighbours: m (1 - m) / (1 - 2 m (1 - m))."""
    product = min(alike / (1 + 2 * alike), 0.25)
    return float((1 - np.sqrt(1 - 4 * product)) / 2)


def _with_lines(shared: SharedNoise, found: DetectorNoise, data: CaptureData) -> SharedNoise:
    rows, columns = (v if v > NOISE_SURE * found.rows_error else 0.0 for v in (found.rows, found.columns))
    height, width = data.usable.shape
    return replace(shared, rows=rows, columns=columns, wide=1 + rows * width + columns * height)


def _lines(shared: SharedNoise, data: CaptureData) -> tuple[float, float]:
    """Variance of the offsets of rows and of columns, full scales squared."""
    if not (shared.rows or shared.columns):
        return 0.0, 0.0
    # They are told relative to the noise of each state, of which the dark ones show most.
    variance = data.variance_of(data.usable).mean(axis=2)
    usual = 1 / float(np.mean(1 / np.maximum(variance, 1e-300)))
    return shared.rows * usual, shared.columns * usual


def noise_factors(found: DetectorNoise, shown: float, estimated: bool) -> tuple[float, float]:
    """Factors on the variance with and without light; one where the images agree with what is declared."""
    both = np.array([found.shot, found.dark]) / shown
    white = found.white / shown
    inverse = np.asarray(np.linalg.inv(found.covariance / shown**2), dtype=float)
    if estimated:
        return _balanced(found, white, max(float(both[1]), LEAST_DARK))
    usual = 1.0, 1.0
    bent = found.bent
    least = NOISE_OFF if shown == 1 else NOISE_OFF_MIXED
    far = not min(bent, 1.0) - least < white < max(bent, 1.0) + least
    if _against(both, usual, inverse) < NOISE_SURE**2 or not (far or _dark_is_off(found, shown)):
        return usual
    # As simple as the images allow: another gain, another read noise, both.
    scales = np.geomspace(1 / MOST_GAIN, MOST_GAIN, GAINS)
    gain = min(((s, s**2) for s in scales), key=lambda p: _against(both, p, inverse))
    darks = np.geomspace(LEAST_DARK_FACTOR, MOST_DARK_FACTOR, DARKS)
    read = min(((1.0, d) for d in darks), key=lambda p: _against(both, p, inverse))
    simple = min(gain, read, key=lambda p: _against(both, p, inverse))
    if _against(both, simple, inverse) < AS_GOOD**2:
        return float(simple[0]), float(simple[1])
    return _balanced(found, white, max(float(both[1]), LEAST_DARK))


def _against(both: Array, told: tuple[float, float], inverse: Array) -> float:
    off = both - np.array(told)
    return float(off @ inverse @ off)


def _dark_is_off(found: DetectorNoise, shown: float) -> bool:
    return abs(found.dark / shown - 1) > max(
        DARK_NOISE_OFF, NOISE_SURE * float(np.sqrt(found.covariance[1, 1])) / shown
    )


def _balanced(found: DetectorNoise, white: float, dark: float) -> tuple[float, float]:
    """Both factors with the whole as found, which is known best."""
    light = found.light_share
    shot = (white - dark * (1 - light)) / light if light > LEAST_LIT else 1.0
    return (shot, dark) if shot > 0 else (white, white)


def _white_in_words(data: CaptureData, white: float, shot: float, dark: float) -> str:
    out = f"the variance of a pixel is {white:.2f} times what is declared ({data.noise_source})"
    if not data.slope.any():
        return out
    # Variance = light / gain + (read noise / gain)^2, of a state that is not a mean of several frames.
    slope, floor = (float(v.max()) * data.binned**2 for v in (data.slope, data.floor))
    gain = 1 / (slope * shot * data.conditions.full_scale)
    read = np.sqrt(floor * dark) * data.conditions.full_scale * gain
    same_electrons = np.isclose(dark, shot**2)
    parts = ([] if shot == 1 else [f"a gain of {gain:.2g} e/count"]) + (
        [] if same_electrons else [f"a read noise of {read:.2g} e"]
    )
    return f"{out}, as of {' and '.join(parts)}"
