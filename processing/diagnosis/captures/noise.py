"""The noise of a capture: as declared, unless its own images show another.

The model's rows, and what the residual of all pixels has in common, are subtracted. Differences of pixels a few apart
then have twice the variance of the noise, whatever the instrument does. How that depends on distance, direction and
light distinguishes the kinds of noise.
"""

from dataclasses import dataclass, replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captures.binning import MOST_FITTED
from processing.diagnosis.captures.black_jitter import black_jitter
from processing.diagnosis.captures.capture_data import CaptureData, SharedNoise, mixed_part
from processing.diagnosis.captures.outliers import Whitened, count_equal
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.diagnosis.search.rules import (
    DARK_NOISE_OFF,
    FEWEST_FREE,
    FEWEST_OF_MANY,
    LIMIT,
    LITTLE,
    NOISE_OFF,
    SHOWN,
    SMALL,
    TILES,
)
from processing.storage.captures.capture import CaptureError

#: [pixels] Distances over which noise is no longer alike, and the image has hardly changed.
FAR_PX = 3, 4
#: [1] Deviation of the variance of a pixel that is told where neighbours share noise: what a pixel shows of it is not
#: known better.
NOISE_OFF_MIXED = 0.15
#: [1] Factors on the gain, or on the variance without light, that are tried: steps of a percent.
FACTORS = np.geomspace(0.01, 400.0, 1000).tolist()


@dataclass(frozen=True)
class DetectorNoise:
    """Noise of the detector as the images show it.

    Attributes
    ----------
    white, white_error : variance of a pixel over what is declared.
    shot, dark, covariance : the parts of the variance with and without light over what is declared, (2, 2);
        light_share : part of the variance declared that goes with the light.
    right, down : correlation of neighbours across and down; alike_error : its standard error.
    bent : variance of a pixel over what is declared, by a bend of the response that the residual may show: a response
        that flattens compresses noise too.
    rows, columns : variance that is common to a row, or a column, of a frame, over that of a pixel; 0: none shows.
    """

    white: float
    white_error: float
    shot: float
    dark: float
    covariance: Array
    light_share: float
    right: float
    down: float
    alike_error: float
    bent: float
    rows: float
    columns: float


def detector_noise(data: CaptureData, a: Array) -> DetectorNoise | None:
    """Noise of a capture against rows a (L, K) of its model; None where its images do not show it.

    Raises CaptureError: the frames have none.
    """
    height, width = data.usable.shape
    if min(height, width) < TILES:
        return None
    rows = min(height, max(TILES, MOST_FITTED // (width * data.values_per_pixel)))
    part = slice((height - rows) // 2, (height - rows) // 2 + rows)
    looked_at = np.zeros(data.usable.shape, dtype=bool)
    looked_at[part] = (data.usable & ~data.clipped)[part]
    # Bright pixels have most of the noise: few of them beside many dark ones do not show it.
    if count_equal(data.variance(looked_at).sum(axis=(0, 1), dtype=float)) <= FEWEST_OF_MANY:
        return None
    white = Whitened.of(data, a, looked_at)
    if white.outside.shape[1] < FEWEST_FREE:
        return None
    projector = white.projector(np.ones(white.y.shape[1], dtype=bool))
    floor = np.repeat(data.floor, data.signal.shape[1])[data.row_counts] / white.level**2
    r, light, dark = np.full((3, len(projector), rows, width), np.nan)
    good = looked_at[part]
    r[:, good] = projector @ white.y
    dark[:, good] = (projector**2 @ floor)[:, None]
    light[:, good] = projector**2 @ white.variance - dark[:, good]
    scatter = np.sqrt(_half_square(r, light + dark, FAR_PX[0], 2)) * white.level.mean()
    if not scatter > NEARLY_ZERO * float(np.mean(np.abs(data.signal[..., part, :]))):
        raise CaptureError(
            f"{data.name}: its frames have no noise: neighbouring pixels differ by less than numbers are rounded. "
            "`diagnose` weighs each difference by the noise. Give frames of a camera, or add noise to calculated ones."
        )
    return replace(compare_scatter(r, light, dark, float(np.trace(projector)) / len(projector)), bent=_of_a_bend(white))


def _of_a_bend(white: Whitened) -> float:
    """Factor on the variance of the curve u + c u^2 that the residual fits best."""
    level = white.level[:, None].astype(np.float32)
    u = white.inside @ (white.inside.T @ white.y) * level
    bend = white.outside.T @ (u**2 / level)
    c = np.sum(bend * (white.outside.T @ white.y)) / max(float(np.sum(bend**2)), 1e-300)
    return float(np.mean(np.maximum(1 + 2 * c * u, 0.0) ** 2))


def compare_scatter(r: Array, light: Array, dark: Array, free: float) -> DetectorNoise:
    """Compare the scatter of a residual with the declared variances.

    The residual r (L, rows, columns) and its variances by light and in the dark are in units of full scale; NaN where a
    pixel does not count. `free` is the share of the noise that the fit has not taken up.
    """
    expected = light + dark
    white = float(np.mean([_half_square(r, expected, lag, 2) for lag in FAR_PX]))
    # Bright pixels have most of the variance: what scatters is a sum of as many as they are.
    error = white * float(np.sqrt(3 * np.nansum(expected**2) / free)) / float(np.nansum(expected))
    (right, right_error), (down, down_error) = (_alike(r, expected, axis) for axis in (2, 1))
    rows, columns = (
        _common(r / np.sqrt(white), expected, axis, alike=alike / white, free=free)
        for axis, alike in ((2, right), (1, down))
    )
    shot, floor, covariance = _levels(r, light, dark, free)
    return DetectorNoise(
        white=white,
        white_error=error,
        shot=shot,
        dark=floor,
        covariance=covariance,
        light_share=float(np.nansum(light) / np.nansum(expected)),
        right=right / white,
        down=down / white,
        alike_error=max(right_error, down_error) / white,
        bent=1.0,
        rows=rows,
        columns=columns,
    )


def _pairs(x: Array, lag: int, axis: int) -> tuple[Array, Array]:
    before = (slice(None),) * axis
    return x[(*before, slice(-lag))], x[(*before, slice(lag, None))]


def _half_square(r: Array, expected: Array, lag: int, axis: int) -> float:
    """Half the square of differences over such a distance, over the variance that is expected."""
    first, second = _pairs(r, lag, axis)
    v1, v2 = _pairs(expected, lag, axis)
    return float(np.nansum((first - second) ** 2) / np.nansum(np.where(np.isfinite(first - second), v1 + v2, 0)))


def _alike(r: Array, expected: Array, axis: int) -> tuple[float, float]:
    """Variance that neighbours over an axis share, over what is expected, and its standard error.

    What pixels further off share is the pattern of a fault. The products of pairs show the error: the rows of one pair
    go together, and few bright pairs can have most of the weight.
    """
    shared, variance = [], []
    for lag in (1, *FAR_PX):
        product = np.prod(_pairs(r, lag, axis), axis=0)
        of_noise = np.where(np.isfinite(product), np.mean(_pairs(expected, lag, axis), axis=0), 0.0)
        shared.append(float(np.nansum(product) / of_noise.sum()))
        variance.append(float(np.sum(np.nansum(product, axis=0) ** 2) / of_noise.sum() ** 2))
    return shared[0] - float(np.mean(shared[1:])), float(np.sqrt(variance[0] + np.mean(variance[1:]) / 2))


def _common(r: Array, expected: Array, axis: int, *, alike: float, free: float) -> float:
    """Variance that is common to a line over that of a pixel, from means over an axis; 0 where it may be chance.

    A line of few pixels tells less, and its mean has more of their noise; of `alike` neighbours more still.
    """
    counts = np.maximum(np.isfinite(r).sum(axis=axis), 1)
    mean, variance = np.nansum(r, axis=axis) / counts, np.nansum(expected, axis=axis) / counts
    variance[variance == 0] = np.nan
    of_mean = variance / counts * (1 + 2 * max(alike, 0.0))
    (first, second), (v1, v2), (n1, n2) = (_pairs(x, FAR_PX[0], 1) for x in (mean, variance, of_mean))
    noise = n1 + n2
    weight = (v1 + v2) / noise**2
    total = np.nansum(weight * (v1 + v2))
    # Every line is in two differences.
    error = np.sqrt(3 / free * np.nansum((weight * noise) ** 2)) / total
    common = float(np.nansum(weight * ((first - second) ** 2 - noise)) / total)
    return common if common > LIMIT * error else 0.0


def _levels(r: Array, light: Array, dark: Array, free: float) -> tuple[float, float, Array]:
    """Parts of the variance with and without light over what is declared, and their covariance."""
    first, second = _pairs(r, FAR_PX[0], 2)
    half = (first - second) ** 2 / 2
    used = np.isfinite(half)
    design = np.stack([np.mean(_pairs(x, FAR_PX[0], 2), axis=0)[used] for x in (light, dark)], axis=1)
    factors = np.ones(2)
    for _ in range(3):
        weight = 1 / (design @ np.maximum(factors, LITTLE)) ** 2
        # Where the images do not tell both parts apart, both are as declared.
        normal = (design * weight[:, None]).T @ design + LITTLE * np.eye(2)
        factors = np.linalg.solve(normal, (design * weight[:, None]).T @ half[used] + LITTLE)
    # A difference has the noise of two pixels, and each pixel is in two of them.
    return float(factors[0]), float(factors[1]), np.asarray(3 * normal.shape[0] / 2 / free * np.linalg.inv(normal))


def checked_noise(data: CaptureData, a: Array) -> CaptureData:
    """The capture with the noise that its images show against rows a (L, K) of its model, and what is to be told.

    A black level that jitters is taken off, as far as it shows.
    """
    notes: list[str] = []
    jitter = black_jitter(data, a) if data.noise_known else None
    if jitter is not None:
        offsets, variance = jitter
        notes.append(_noise_note("the black level is another one in every frame", variance, data))
        level = offsets.reshape(*data.signal.shape[:2], 1, 1)
        data = replace(data, signal=(data.signal - level).astype(np.float32))
    noise = detector_noise(data, a) if data.noise_known else None
    if noise is None:
        return replace(data, noise_told=tuple(notes))
    shared = _shared_by_neighbours(noise)
    if shared.shown < 1:
        notes.append(
            f"neighbours share noise (correlation {noise.right:.2f} across, {noise.down:.2f} down): the images were "
            f"resampled or smoothed, and of {1 / shared.shown:.1f} pixels one is independent"
        )
    if noise.rows or noise.columns:
        shared = replace(shared, rows=noise.rows, columns=noise.columns)
    lines, wide = _lines(shared, data), _wide(shared, data)
    for name, part in zip(("row", "column"), lines, strict=True):
        if part > 0:
            notes.append(_noise_note(f"every {name} of a frame has an offset of its own", part, data))
    shot, dark = factors = noise_factors(noise, shared.shown, data.noise_estimated)
    white = None
    if not data.noise_estimated and factors != (1.0, 1.0):
        white = _white_in_words(data, noise.white / shared.shown, shot, dark)
    # What is common to a line is a part of the variance of its pixels, and more of that of wide patterns.
    slope, floor = data.slope * shot * wide, (data.floor * dark + sum(lines)) * wide
    data = replace(data, wide=None if np.all(wide == 1) else wide)
    return replace(
        data, slope=slope, floor=floor, shared=shared, noise_factors=factors, noise_told=tuple(notes), white_told=white
    )


def _noise_note(text: str, variance: float, data: CaptureData) -> str:
    return f"{text}, {np.sqrt(variance) * data.conditions.full_scale:.2g} counts rms"


def _shared_by_neighbours(noise: DetectorNoise) -> SharedNoise:
    least = max(SMALL, LIMIT * noise.alike_error)
    # The correlation of neighbours is m (1 - m) / (1 - 2 m (1 - m)).
    parts = (mixed_part(min(c / (1 + 2 * c), 0.25)) if c > least else 0.0 for c in (noise.right, noise.down))
    return SharedNoise(*parts)


def _wide(shared: SharedNoise, data: CaptureData) -> Array:
    """Variance (N,) of a pattern as wide as the image over what independent pixels would give it."""
    height, width = data.usable.shape
    lines = np.full(len(data.slope), 1 + shared.rows * width + shared.columns * height)
    if data.rounding is None:
        return lines
    variance = data.variance(data.usable).mean(axis=(1, 2))
    rounding = data.usable.sum() * data.rounding / np.maximum(variance, data.floor)
    return lines + np.where(rounding > LITTLE, rounding, 0.0)


def _lines(shared: SharedNoise, data: CaptureData) -> tuple[float, float]:
    """Variance of the offsets of rows and of columns, full scales squared."""
    if not (shared.rows or shared.columns):
        return 0.0, 0.0
    # They are told relative to the noise of each state, of which the dark ones show most.
    variance = data.variance(data.usable).mean(axis=2)
    usual = 1 / float(np.mean(1 / np.maximum(variance, 1e-300)))
    return shared.rows * usual, shared.columns * usual


def noise_factors(noise: DetectorNoise, shown: float, estimated: bool) -> tuple[float, float]:
    """Factors on the variance with and without light; one where the images agree with what is declared."""
    factors = np.array([noise.shot, noise.dark]) / shown
    white = noise.white / shown
    inverse = np.asarray(np.linalg.inv(noise.covariance / shown**2), dtype=float)
    usual = 1.0, 1.0
    if estimated:
        if _distance(factors, usual, inverse) < LIMIT**2:
            return usual
        return _balance(noise, white, max(float(factors[1]), SMALL))
    bent = noise.bent
    least = NOISE_OFF if shown == 1 else NOISE_OFF_MIXED
    far = not min(bent, 1.0) - least < white < max(bent, 1.0) + least
    if _distance(factors, usual, inverse) < LIMIT**2 or not (far or _dark_is_off(noise, shown)):
        return usual
    # As simple as the images allow: another gain, another read noise, both.
    gains, reads = ((s, s**2) for s in FACTORS), ((1.0, s) for s in FACTORS)
    simple = min((*gains, *reads), key=lambda p: _distance(factors, p, inverse))
    if _distance(factors, simple, inverse) < SHOWN**2:
        return simple
    return _balance(noise, white, max(float(factors[1]), SMALL))


def _distance(factors: Array, expected: tuple[float, float], inverse: Array) -> float:
    off = factors - np.array(expected)
    return float(off @ inverse @ off)


def _dark_is_off(noise: DetectorNoise, shown: float) -> bool:
    return abs(noise.dark / shown - 1) > max(DARK_NOISE_OFF, LIMIT * float(np.sqrt(noise.covariance[1, 1])) / shown)


def _balance(noise: DetectorNoise, white: float, dark: float) -> tuple[float, float]:
    """Both factors with the whole as found, which is known best."""
    light = noise.light_share
    shot = (white - dark * (1 - light)) / light if light > SMALL else 1.0
    return (shot, dark) if shot > 0 else (white, white)


def _white_in_words(data: CaptureData, white: float, shot: float, dark: float) -> str:
    text = f"the variance of a pixel is {white:.2f} times what is declared ({data.noise_source})"
    if not data.slope.any():
        return text
    # Variance = light / gain + (read noise / gain)^2, of a state that is not a mean of several frames.
    slope, floor = (float(v.max()) * data.binned**2 for v in (data.slope, data.floor))
    gain = 1 / (slope * shot * data.conditions.full_scale)
    read = np.sqrt(floor * dark) * data.conditions.full_scale * gain
    same_electrons = np.isclose(dark, shot**2)
    parts = ([] if shot == 1 else [f"a gain of {gain:.2g} e/count"]) + (
        [] if same_electrons else [f"a read noise of {read:.2g} e"]
    )
    return f"{text}, as of {' and '.join(parts)}"
