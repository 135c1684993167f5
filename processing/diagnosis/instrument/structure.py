"""Is anything but noise left over, and what does it look like: tests of the residual, and a description in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.features import MARGIN, inside
from processing.diagnosis.instrument.pixel_sums import Pixels
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import add_response, response_slopes
from processing.diagnosis.instrument.tiles import tile_columns
from processing.diagnosis.search.decision import in_deviations, in_words
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.linearization import deviation_of
from processing.diagnosis.search.range_of import RANK, range_of
from processing.diagnosis.search.rules import FEWEST_OF_MANY, FEWEST_PIXELS, TILES
from processing.diagnosis.search.space import Space
from processing.instrument.changes import FIELD_TERMS, Changes, field_terms
from processing.reduction.move_image import neighbour_noise

#: [harmonics] Of a turn that are shown of a residual: an element that turns makes four.
HARMONICS = 4


@dataclass(frozen=True)
class Residual:
    """Residual of one capture.

    Attributes
    ----------
    image : (L, rows, columns) residual in units of the noise; NaN where a pixel is not used.
    per_state : (L,) rms over the pixels; mean : (L,) mean over the pixels.
    tests : name to standard deviations from what noise gives.
    harmonics : axis to amplitudes (HARMONICS,) of the state means, in units of the noise of one intensity.
    correlates : name to correlation of the rms map or of the residual with it.
    leading : (L,) leading component over the states, with its share of the sum of squares.
    excess : chi-square of the structure, as the test that finds most of it beyond two standard deviations has it.
    """

    image: NDArray[np.float32]
    per_state: Array
    mean: Array
    tests: dict[str, float]
    harmonics: dict[str, Array]
    correlates: dict[str, float]
    leading: Array
    leading_share: float
    excess: float = 0.0


def compute_residual(problem: InstrumentProblem, capture: int, space: Space, fit: Fit) -> Residual:
    """Residual of a capture at the values of a fit, pixel by pixel, and its tests."""
    problem, values = problem.near(space, fit.values)
    data, moments = problem.captures[capture], problem.moments[capture]
    changes = problem.changes(capture, space, values)
    a = problem.columns(capture, changes) * moments.sigma[:, None]
    rows = a.shape[0]
    height, width = data.signal.shape[2:]
    usable = data.usable
    if data.steep is not None and data.moved_px is None and not any(c.reaches_around for c in space.candidates):
        # Where nothing was moved or is said to move, edges must fit as well: a focus that changes shows nowhere else.
        usable = usable | data.steep
    used = (usable & ~data.clipped if changes.drop_clipped else usable) & inside(height, width)
    coefficients, whitened = problem.coefficients(capture, changes), problem.columns(capture, changes)
    counts = data.signal.reshape(rows, height, width)
    y, slopes = add_response(counts, coefficients, whitened), response_slopes(counts, coefficients)
    level, pixels = moments.sigma, Pixels(data)
    free = np.zeros((rows, height, width), dtype=np.float32)
    signal = np.zeros((rows, height, width), dtype=np.float32)
    for area, columns in _parts(problem, capture, changes, a):
        q = range_of(columns / level[:, None] * moments.counts[:, None])
        part = y[:, *area]
        onto = (q * level[:, None]).astype(np.float32) @ (q.T / level).astype(np.float32)
        signal[:, *area] = (onto @ part.reshape(rows, -1)).reshape(part.shape)
        free[:, *area] = (1 - np.sum(q * q, axis=1))[:, None, None]
    r = y - signal
    with np.errstate(divide="ignore", invalid="ignore"):
        r /= level[:, None, None].astype(np.float32) * np.sqrt(pixels.scale).astype(np.float32)
    r[:, ~used] = np.nan
    # Of a row that does not count nothing is left, and no noise is expected.
    r[~moments.counts], free[~moments.counts] = np.where(used, 0.0, np.nan), 0.0
    around = _average_corners(signal)
    signal[:, ~used], free[:, ~used] = 0.0, 0.0
    expected = free
    per_scale = np.where(used, 1 / np.where(used, pixels.scale, 1.0), 0.0)
    for row, of_row in enumerate(expected):
        of_row *= pixels.variance_of(row) / level[row] ** 2 * per_scale
        if slopes is not None:
            of_row *= slopes[row] ** 2
    good = np.asarray(np.isfinite(r).all(axis=0))
    tests: dict[str, float] = {}
    chi2 = 0.0
    if data.noise_known and good.any():
        shown, alike, spread = moments.shown, _neighbour_noise(data), moments.spread
        tests, chi2 = structure_tests(
            r, around, expected, good, shown=shown, alike=alike, columns=a.shape[1], spread=spread
        )
    n, channels = data.signal.shape[:2]
    mean = r[:, good].mean(axis=1) if good.any() else np.zeros(rows)
    states = mean.reshape(n, channels).mean(axis=1)
    harmonics = {axis: harmonics_of(states, v) for axis, v in data.conditions.angles_deg.items()}
    flat = r[:, good]
    moment = flat @ flat.T / max(flat.shape[1], 1)
    value, vector = np.linalg.eigh(moment.astype(np.float64))
    return Residual(
        image=r,
        per_state=np.sqrt(np.mean(flat**2, axis=1)) if good.any() else np.zeros(rows),
        mean=mean,
        tests=tests,
        harmonics=harmonics,
        correlates=correlates_of(r, signal, good),
        leading=vector[:, -1],
        leading_share=float(value[-1] / max(value.sum(), 1e-300)),
        excess=chi2,
    )


def harmonics_of(states: Array, angles_deg: Array) -> Array:
    """Amplitudes (HARMONICS,) of values (N,) of the states in periods of a turn."""
    turns = np.deg2rad(angles_deg)
    return np.array([2 * abs(np.mean(states * np.exp(1j * h * turns))) for h in range(1, HARMONICS + 1)])


def _neighbour_noise(data: CaptureData) -> Array:
    """Covariance (L, 2) of the noise of neighbours down and across, in units of that of wide patterns."""
    shared = data.shared
    moved = np.array([neighbour_noise(x, y, shared.right, shared.down) for x, y in data.row_moved_px])
    return np.asarray((moved + np.array([shared.columns, shared.rows])) / data.row_wide[:, None])


def _average_corners(signal: NDArray[np.float32]) -> NDArray[np.float32]:
    """The fit of four pixels around each.

    A pixel's own fit shares noise with its residual, since the states of a pixel are not equally noisy: with some
    100 000 pixels that shows.
    """
    wide = np.pad(signal, ((0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN)), mode="edge")
    last = 2 * MARGIN
    corners = (
        wide[:, y : wide.shape[1] - last + y, x : wide.shape[2] - last + x] for y in (0, last) for x in (0, last)
    )
    return np.asarray(sum(corners) / 4, dtype=np.float32)


def _parts(
    problem: InstrumentProblem, capture: int, changes: Changes, a: Array
) -> list[tuple[tuple[slice, slice], Array]]:
    """Parts of the image, each with its matrix (L, K)."""
    moments = problem.moments[capture]
    tiles = moments.tiles
    if not changes.field_retardance_rad or tiles is None:
        return [((slice(None), slice(None)), a)]
    columns = (
        tile_columns(problem.models[capture], problem.captures[capture], moments, changes) * moments.sigma[:, None]
    )
    return list(zip(tiles.boxes, columns, strict=True))


def structure_tests(
    r: NDArray[np.float32],
    around: NDArray[np.float32],
    expected: NDArray[np.float32],
    good: NDArray[np.bool_],
    *,
    shown: Array,
    alike: Array,
    columns: int,
    spread: float,
) -> tuple[dict[str, float], float]:
    """Chi-square of each test over its standard deviation, and the largest that is certainly left.

    Of a residual r (L, rows, columns) in units of the noise, the fit `around` in counts, and the variance that is
    `expected` of a smooth pattern, at `good` pixels. `shown` (L,) is the part of the noise that single pixels show,
    `alike` (L, 2) what neighbours down and across share of it.
    """
    count = int(good.sum())
    flat, noise = r[:, good], expected[:, good]
    # Of smooth patterns moved frames keep all the noise, of single pixels only a part.
    freedom = shown @ noise.sum(axis=1, dtype=float)
    # Name to chi-square beyond noise, its standard deviation with nothing but noise, and what noise gives.
    tests = {"sum of squares": (_square(flat) - freedom, deviation_of(max(freedom, 1e-300), spread), freedom)}
    if count < FEWEST_PIXELS:
        # What goes with the signal, or with the place, needs an image.
        return in_deviations(tests)
    # Linear in the signal: every pixel's residual against the leading components of the fitted signal near by.
    s = around[:, good]
    _, size, vt = np.linalg.svd((s @ s.T).astype(float))
    keep = min(columns, int(np.sum(size > RANK * size[0])))
    turned = vt[:keep] / np.sqrt(np.maximum(size[:keep], 1e-300))[:, None]
    weights = turned.astype(np.float32) @ s
    linear = flat @ weights.T
    null = (noise @ (weights.T**2)).sum(dtype=float)
    tests["linear in the signal"] = (_square(linear) - null, np.sqrt(2 * null * spread), null)
    # Brightness: against the square of the signal, its linear part taken away.
    np.square(s, out=s)
    s -= (s @ weights.T) @ weights
    s /= np.sqrt(np.sum(s**2, axis=1, keepdims=True, dtype=float)).astype(np.float32) + np.float32(1e-30)
    along = np.sum(flat * s, axis=1, dtype=float)
    expectation = np.sum(noise * s**2, dtype=float)
    # Rows of one pixel go together, since its unknowns are projected out: a sum of squares of all has this deviation.
    tests["brightness"] = along @ along - expectation, np.sqrt(2 * expectation * spread + 1e-300), expectation
    # Neighbours: noise of two pixels is independent, or as alike as moving the frames has made it.
    for k, name in enumerate(("neighbours, rows", "neighbours, columns")):
        if r.shape[k + 1] > 2:
            first, second = (slice(None),) * (k + 1) + (slice(-1),), (slice(None),) * (k + 1) + (slice(1, None),)
            is_pair = good[first[1:]] & good[second[1:]]
            product = r[first] * r[second]
            product[:, ~is_pair] = 0.0
            if is_pair.sum() * len(r) > FEWEST_OF_MANY:
                null = alike[:, k] @ np.sum(expected[first], axis=(1, 2), where=is_pair, dtype=float)
                # The residuals of the rows of one pixel go together: a pair of pixels counts as one.
                pairs = product.sum(axis=0, dtype=float)
                tests[name] = (pairs.sum() - null, np.sqrt(_square(pairs)), np.inf)
    # Tiles: mean residual of every row over patches of the image.
    tests["patches"] = _patches(r, expected, spread)
    return in_deviations(tests)


def _square(x: NDArray[np.floating]) -> float:
    return float(np.sum(x**2, dtype=float))


def _patches(r: NDArray[np.float32], expected: NDArray[np.float32], spread: float) -> tuple[float, float, float]:
    side = max(r.shape[1] // TILES, 1)
    h, w = r.shape[1] // side * side, r.shape[2] // side * side
    shape = (r.shape[0], h // side, side, w // side, side)
    total = np.nansum(r[:, :h, :w].reshape(shape), axis=(2, 4), dtype=np.float64)
    null = np.where(np.isfinite(r[:, :h, :w]), expected[:, :h, :w], 0).reshape(shape).sum(axis=(2, 4), dtype=np.float64)
    of_noise = null.sum() / side**2
    return float(np.sum(total**2) / side**2 - of_noise), float(np.sqrt(2 * of_noise * spread + 1e-300)), float(of_noise)


def correlates_of(r: NDArray[np.float32], signal: NDArray[np.float32], good: NDArray[np.bool_]) -> dict[str, float]:
    """Correlation of the size of a residual r (L, rows, columns) with maps of the image, over the good pixels.

    A map, or a residual, that is equal everywhere correlates with nothing and is left out.
    """
    if good.sum() < FEWEST_PIXELS or min(r.shape[1:]) < 3:
        return {}
    loud = np.sqrt(np.mean(np.nan_to_num(r) ** 2, axis=0))
    mean = signal.mean(axis=0)
    gy, gx = np.gradient(mean)
    ys, xs = np.mgrid[-1 : 1 : r.shape[1] * 1j, -1 : 1 : r.shape[2] * 1j]
    maps = {"brightness": mean, "gradient of the image": np.hypot(gx, gy)}
    maps |= dict(zip(FIELD_TERMS, field_terms(xs, ys), strict=True))
    correlations = {}
    for name, image in maps.items():
        x, y = loud[good], image[good]
        # The mean of equal numbers may round to another one, so that their standard deviation is not zero.
        if np.ptp(x) > 0 and np.ptp(y) > 0:
            correlations[name] = float(np.corrcoef(x, y)[0, 1])
    return correlations


def descriptions(names: Sequence[str], residuals: Sequence[Residual]) -> tuple[str, ...]:
    """Sentences about what captures leave over, each with the name of its capture where there are several."""
    several = len(names) > 1
    return tuple(
        f"{name}: {line}" if several else line
        for name, of_capture in zip(names, residuals, strict=True)
        for line in description(of_capture)
    )


def description(r: Residual) -> list[str]:
    """Sentences about what is left over; empty if nothing is."""
    lines = in_words(r.tests)
    if not lines:
        return []
    order = np.argsort(-np.abs(r.mean))[:3]
    lines.append("states that are furthest off on average: " + ", ".join(str(int(k)) for k in order))
    if r.leading_share > 0:
        lines.append(f"the leading component over the states holds {100 * r.leading_share:.0f} % of what is left")
    for axis, amplitudes in r.harmonics.items():
        h = int(np.argmax(amplitudes))
        lines.append(f"strongest harmonic of {axis}: {h + 1} a turn, {amplitudes[h]:.2g} of the noise of one intensity")
    if r.correlates:
        name = max(r.correlates, key=lambda k: abs(r.correlates[k]))
        lines.append(f"its map goes with {name} (correlation {r.correlates[name]:+.2f})")
    return lines
