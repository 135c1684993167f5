"""Plain and weighted solver against numpy, one pixel at a time, where everything that they know of comes together.

Two beams, three exposures with darks of two of them, repeats, a flat, saturated and struck intensities, pixels without
light, a pixel with too few states left.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from processing.errors import ProcessError
from processing.reduction.black import Black
from processing.reduction.counts_to_signal import BlockReader, CountCorrection
from processing.reduction.flat import FlatField
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers import plain, weighted
from processing.reduction.solvers.inversion import Inversion
from processing.reduction.solvers.plain import LEAST, MuellerSolver
from processing.reduction.solvers.weighted import PACKED_COLUMN, PACKED_ROW, WeightedSolver
from processing.storage.captures.capture import Capture
from processing.storage.products.pixel_mask import Mask

STATES, CHANNELS, ROWS, COLUMNS = 30, 2, 3, 25
DARKS = 6
BLACK, TOP = 64.0, 4095.0
GAIN, READ = 2.0, 12.0
#: Where what happens: all other pixels are sound.
NO_LIGHT, SATURATED, STRUCK, LOST, BAD = (2, 14), (20, 41, 74), (2, 20, 55), 33, 60
NOISE = NoiseModel(1 / GAIN, (READ / GAIN) ** 2, 1 / 12, "test")


def matrix(kind):
    """W (states x channels, 16) of random generators and of analyzers that do or do not see circular light."""
    random = np.random.default_rng(4)
    sent = random.normal(size=(STATES, 3))
    analyzed = random.normal(size=(STATES, 3))
    if kind == "partial":
        analyzed[:, 2] = 0.0
    sent, analyzed = (v / np.linalg.norm(v, axis=1)[:, None] for v in (sent, analyzed))
    two = np.stack([analyzed, -analyzed], axis=1)
    generator = np.hstack([np.ones((STATES, 1)), sent])
    analyzer = np.concatenate([np.ones((STATES, CHANNELS, 1)), two], axis=2)
    return 0.5 * np.einsum("ncj,nk->ncjk", analyzer, generator).reshape(-1, 16)


@dataclass
class Bench:
    """A capture of known noise with what the solvers are given."""

    w: np.ndarray
    inversion: Inversion
    reader: BlockReader
    frames: np.ndarray
    correction: CountCorrection
    sound: np.ndarray

    def signal(self):
        """Signal (N, pixels) and 1 / flat (N, pixels), by hand."""
        light = self.frames.reshape(STATES, CHANNELS, -1).astype(float)
        black = np.tensordot(self.reader.black_weights, self.correction.black.means.astype(float), axes=1)
        scale = np.ones((STATES, CHANNELS, ROWS * COLUMNS))
        if self.correction.flat is not None:
            scale = scale / self.correction.flat.response.reshape(CHANNELS, -1)
        return ((light - black.reshape(light.shape)) * scale).reshape(STATES * CHANNELS, -1), scale.reshape(
            STATES * CHANNELS, -1
        )

    def black_pushes(self, scale):
        """What one standard error of each black does to the signal of one pixel: columns (N, blacks x channels)."""
        sigma = np.sqrt(self.correction.black.mean_variance(NOISE))
        pushes = []
        for channel in range(CHANNELS):
            for weights, error in zip(self.reader.black_weights.T, sigma, strict=True):
                push = np.zeros((STATES, CHANNELS))
                push[:, channel] = weights * error
                pushes.append(push.ravel() * scale)
        return np.stack(pushes, axis=1)


@pytest.fixture(params=["even", "flat"])
def flat(request):
    if request.param == "even":
        return None
    response = np.random.default_rng(2).uniform(0.5, 1.5, (CHANNELS, ROWS, COLUMNS)).astype(np.float32)
    return FlatField(response, 1, np.ones(CHANNELS), np.zeros((ROWS, COLUMNS), bool), "test")


@pytest.fixture(params=["whole", "partial"])
def bench(request, flat, synthetic_capture, monkeypatch):
    monkeypatch.setattr(plain, "TILE", 32)
    monkeypatch.setattr(weighted, "TILE", 16)
    monkeypatch.setattr(plain, "REPAIR_BATCH", 2)
    random = np.random.default_rng(1)
    w = matrix(request.param)
    basis = np.eye(16)[:, :12] if request.param == "partial" else np.eye(16)
    pixels = ROWS * COLUMNS
    m = 900 * np.concatenate([np.ones((1, pixels)), random.uniform(-0.3, 0.3, (15, pixels))])
    m[:, NO_LIGHT] = 0.0
    light = (w @ m).reshape(STATES, CHANNELS, pixels)
    if flat is not None:
        light = light * flat.response.reshape(CHANNELS, pixels)
    repeats = np.concatenate([np.tile([1, 2, 4], DARKS // 3), np.tile([1, 2, 4], STATES // 3)])
    exposure = np.concatenate([np.repeat([0.01, 0.02], DARKS // 2), np.repeat([0.01, 0.02, 0.03], STATES // 3)])
    counts = np.concatenate([np.zeros((DARKS, CHANNELS, pixels)), light])
    sigma = np.sqrt((np.maximum(counts, 0) / GAIN + (READ / GAIN) ** 2) / repeats[:, None, None])
    counts = counts + BLACK + 100 * exposure[:, None, None] + sigma * random.normal(size=counts.shape)
    sound = np.ones((STATES, CHANNELS, pixels), bool)
    for pixel in SATURATED:
        sound[:5, 0, pixel] = False
    sound[:27, :, LOST] = False
    counts[DARKS:][~sound] = TOP
    struck = np.array([[k, 1, *divmod(pixel, COLUMNS)] for pixel in STRUCK for k in (7, 11)])
    sound[struck[:, 0], struck[:, 1], struck[:, 2] * COLUMNS + struck[:, 3]] = False
    bad = np.zeros((ROWS, COLUMNS), bool)
    bad.flat[BAD] = True
    path = synthetic_capture(
        np.clip(np.rint(counts), 0, TOP).astype(np.uint16).reshape(-1, CHANNELS, ROWS, COLUMNS),
        {},
        role=("dark",) * DARKS + ("sample",) * STATES,
        exposure_s=exposure,
        repeats=repeats,
        channels=("left", "right"),
    )
    with Capture(path) as capture:
        black = Black.of(capture)
        correction = CountCorrection(black, "test", flat, bad, TOP)
        reader = BlockReader(capture, np.arange(DARKS, DARKS + STATES), correction, struck=struck)
        frames = reader.read(slice(0, ROWS)).copy()
        yield Bench(w, Inversion.of(w, basis=basis), reader, frames, correction, sound.reshape(-1, pixels))


def floor_of(bench):
    repeats = np.repeat(bench.reader.repeats, CHANNELS)
    excess = np.repeat(bench.correction.black.excess(NOISE, bench.reader.exposure_s), CHANNELS)
    return ((READ / GAIN) ** 2 + excess) / repeats + 1 / 12, 1 / GAIN / repeats


def least_squares(bench, keep):
    """Solution matrix (16, N) of the intensities kept."""
    basis = bench.inversion.basis
    solve = np.zeros((16, len(bench.w)))
    solve[:, keep] = basis @ np.linalg.pinv(bench.w[keep] @ basis)
    return solve


@pytest.mark.parametrize("is_noise_known", [True, False], ids=["noise", "no noise"])
def test_plain_least_squares(bench, is_noise_known):
    maps = MuellerSolver(bench.inversion, bench.reader, NOISE if is_noise_known else None).solve(bench.frames)
    signal, scale = bench.signal()
    floor, slope = floor_of(bench)
    for pixel in range(ROWS * COLUMNS):
        if pixel == LOST:
            continue
        keep = bench.sound[:, pixel]
        solve = least_squares(bench, keep)
        y = signal[:, pixel]
        m = solve @ y
        projector = keep[:, None] * (np.eye(len(y)) - bench.w @ solve) * keep
        rss = np.sum((projector @ y) ** 2)
        if is_noise_known:
            dark = floor * scale[:, pixel] ** 2
            pushes = bench.black_pushes(scale[:, pixel]) * keep[:, None]
            least = solve**2 @ dark + np.sum((solve @ pushes) ** 2, axis=1)
            errors = np.maximum(solve**2 @ (slope * y * scale[:, pixel]) + least, LEAST * least)
            least_rss = np.diag(projector) @ dark + np.sum((projector @ pushes) ** 2)
            expected = max(np.diag(projector) @ (slope * y * scale[:, pixel]) + least_rss, LEAST * least_rss)
            chi_square = rss / expected
        else:
            errors, chi_square = np.full(16, np.nan), np.nan
        is_determined = np.any(bench.inversion.basis, axis=1)
        np.testing.assert_allclose(maps["mueller"][is_determined, pixel], m[is_determined], rtol=2e-4, atol=0.02)
        np.testing.assert_allclose(
            maps["mueller_errors"][is_determined, pixel], np.sqrt(errors[is_determined]), rtol=1e-3
        )
        np.testing.assert_allclose(maps["mueller"][~is_determined, pixel], 0.0, atol=1e-3)
        np.testing.assert_allclose(maps["residual_rms"][pixel], np.sqrt(rss / keep.sum()), rtol=1e-3)
        np.testing.assert_allclose(maps["reduced_chi_square"][pixel], chi_square, rtol=2e-3)
    assert flags(maps) == FLAGS


FLAGS = {
    2: Mask.STRUCK,
    20: Mask.SATURATED | Mask.STRUCK,
    41: Mask.SATURATED,
    74: Mask.SATURATED,
    55: Mask.STRUCK,
    LOST: Mask.SATURATED | Mask.NOT_DETERMINED,
    BAD: Mask.BAD,
}


def flags(maps):
    return {int(pixel): Mask(int(maps["pixel_flags"][pixel])) for pixel in np.flatnonzero(maps["pixel_flags"])}


@pytest.mark.parametrize(("share", "determined"), [(1 / 900, True), (1 / 1100, False)])
def test_what_is_left_determines_a_pixel_or_does_not(share, determined, synthetic_capture):
    """One state for each element, of which one sees next to nothing, and a last one that is saturated."""
    w = np.vstack([np.eye(16), np.eye(16)[-1]])
    w[15] *= share
    counts = np.full((17, 1, 1, 1), 1000.0)
    counts[15], counts[16] = 1000 * share, TOP
    with Capture(synthetic_capture(counts.astype(np.uint16), {}, detector={"bits": 12})) as capture:
        reader = BlockReader(capture, np.arange(17), CountCorrection(Black.level(0.0), "test", saturation=TOP))
        maps = MuellerSolver(Inversion.of(w), reader, NOISE).solve(reader.read(slice(0, 1)))
    assert (flags(maps)[0] == Mask.SATURATED) == determined
    # As many states as unknowns: nothing is left over.
    assert np.isnan(maps["reduced_chi_square"][0])
    np.testing.assert_allclose(maps["mueller"][:15, 0], 1000.0, rtol=1e-5)


def test_noise_weighted_least_squares(bench):
    solver = WeightedSolver(MuellerSolver(bench.inversion, bench.reader, NOISE), covariance=True)
    maps = solver.solve(bench.frames)
    signal, scale = bench.signal()
    floor, slope = floor_of(bench)
    basis = bench.inversion.basis
    for pixel in range(ROWS * COLUMNS):
        if pixel == LOST:
            continue
        keep, y = bench.sound[:, pixel], signal[:, pixel]
        least = floor * scale[:, pixel] ** 2
        fitted = bench.w @ (least_squares(bench, keep) @ y)
        variance = np.maximum(slope * fitted * scale[:, pixel] + least, LEAST * least)
        root = keep / np.sqrt(variance)
        weighted_w = root[:, None] * (bench.w @ basis)
        solve = basis @ np.linalg.pinv(weighted_w)
        m = solve @ (root * y)
        chi_square = np.sum((root * (y - bench.w @ m)) ** 2)
        pushes = bench.black_pushes(scale[:, pixel]) * root[:, None]
        covariance = solve @ solve.T + (solve @ pushes) @ (solve @ pushes).T
        push_residual = pushes - root[:, None] * (bench.w @ (solve @ pushes))
        expected = keep.sum() - basis.shape[1] + np.sum(push_residual * pushes)
        residual = keep * (y - bench.w @ m)
        np.testing.assert_allclose(maps["mueller"][:, pixel], m, rtol=2e-4, atol=0.02)
        size = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(maps["mueller_errors"][:, pixel], size, rtol=1e-3, atol=1e-6)
        packed = maps["mueller_covariance"][:, pixel]
        atol = 1e-3 * size.max() ** 2
        np.testing.assert_allclose(packed, covariance[PACKED_ROW, PACKED_COLUMN], atol=atol)
        np.testing.assert_allclose(maps["reduced_chi_square"][pixel], chi_square / expected, rtol=2e-3)
        np.testing.assert_allclose(maps["residual_rms"][pixel], np.sqrt(np.sum(residual**2) / keep.sum()), rtol=1e-3)
    assert flags(maps) == FLAGS
    assert np.isnan(maps["mueller_errors"][0, LOST])


def test_weights_need_the_noise(bench):
    with pytest.raises(ProcessError, match="does not know its gain"):
        WeightedSolver(MuellerSolver(bench.inversion, bench.reader, None))
