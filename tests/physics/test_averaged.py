"""Means over squares of pixels and in the bins of a table have the errors of what they are made of."""

from dataclasses import replace

import numpy as np
import pytest
from bench_capture import bench_capture, read
from steady_capture import steady_capture

from processing.diagnosis.captures.binning import averaged
from processing.diagnosis.captures.capture_data import SharedNoise
from processing.diagnosis.captures.screening import without_steep_pixels
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.space import Space
from processing.reduction.mosaic.demosaic import demosaic
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.mosaic.noise import neighbour_correlation, stokes_covariance
from processing.reflectance.shared_noise import shared_variance
from simulators.blind.undeclared_captures import TrueBench

SIGMA, SIDE = 2e-3, 3


def test_noise_of_means_is_as_told():
    random = np.random.default_rng(5)
    white = random.normal(0, SIGMA, (4, 301, 300))
    mixed = 0.7 * white[:, :, :-1] + 0.3 * white[:, :, 1:]
    mixed = 0.9 * mixed[:, :-1] + 0.1 * mixed[:, 1:]
    data = replace(steady_capture(0.5 + mixed, SIGMA), shared=SharedNoise(right=0.3, down=0.1))
    means = averaged(data, SIDE)
    noise = means.signal[:, 0] - 0.5
    across, down = means.shared.right * (1 - means.shared.right), means.shared.down * (1 - means.shared.down)
    assert np.var(noise) == pytest.approx(means.floor[0] * means.shared.shown, rel=0.02)
    right = np.mean(noise[:, :, :-1] * noise[:, :, 1:])
    assert right == pytest.approx(means.floor[0] * across * (1 - 2 * down), rel=0.1)
    below = np.mean(noise[:, :-1] * noise[:, 1:])
    assert below == pytest.approx(means.floor[0] * down * (1 - 2 * across), rel=0.2)


def test_offsets_of_lines_weigh_more_beside_means():
    random = np.random.default_rng(6)
    noise = random.normal(0, SIGMA, (6, 240, 240)) + random.normal(0, 0.3 * SIGMA, (6, 240, 1))
    wide = 1 + 0.09 * 240
    data = steady_capture(noise, SIGMA * np.sqrt(wide))
    means = averaged(replace(data, shared=SharedNoise(rows=0.09), wide=np.full(6, wide)), SIDE)
    pixel = means.floor[0] / wide
    rows = means.signal[:, 0].mean(axis=2)
    assert np.var(rows) - pixel / 80 == pytest.approx(means.shared.rows * pixel, rel=0.15)
    np.testing.assert_array_equal(means.wide, wide)


def test_a_square_counts_if_all_its_pixels_do():
    data = steady_capture(np.ones((2, 7, 6)), SIGMA)
    data.usable[3, 1], data.clipped[0, 5] = False, True
    means = averaged(data, SIDE)
    assert means.signal.shape == (2, 1, 2, 2)
    assert means.usable.tolist() == [[True, True], [False, True]]
    assert means.clipped.tolist() == [[False, True], [False, False]]
    assert (means.binned, means.pitch) == (SIDE, SIDE)


@pytest.fixture(scope="module")
def fitted(configs, tmp_path_factory):
    """Azimuth and image drift with their errors: of the pixels, and of means over them."""
    bench = TrueBench(rows=96, columns=96)
    bench.oa += np.deg2rad(0.3)
    bench.shift.append(lambda k, a: (0.02 * k, -0.01 * k))
    file = configs / "instruments/rgb950.yaml"
    model, data = read(bench_capture(tmp_path_factory.mktemp("averaged"), file, bench, states=24), file)
    fits = []
    for each in (data, averaged(data, 2)):
        problem = InstrumentProblem(model, [each])
        space = Space(tuple(c for c in problem.pool() if c.kind in ("psa_azimuth", "image_drift")))
        values = minimize(problem, space, np.zeros(space.size)).values
        curvature = problem.sums(space, values).curvature.sum(axis=0)
        fits.append((values, np.sqrt(np.diag(np.linalg.inv(curvature)))))
    return fits


def test_means_say_what_the_pixels_say(fitted):
    (values, errors), (of_means, their_errors) = fitted
    # Of a small image three rows of squares at each edge, in place of three of pixels, are some of the information.
    assert np.all((errors <= their_errors) & (their_errors < 1.2 * errors))
    assert np.all(np.abs(of_means - values) < 3 * np.sqrt(their_errors**2 - errors**2))
    assert np.all(np.abs(of_means) > 10 * their_errors)


def test_a_slope_is_no_edge_for_squares_either():
    """Of 10 standard deviations a pixel, which is 40 from one square to the next."""
    x = np.arange(120)
    gentle, sharp = 0.3 + 10 * SIGMA * 40 / 2 / np.pi * np.sin(2 * np.pi * x / 40), 0.3 + 100 * SIGMA * (x > 30)
    for image, columns in ((gentle, set()), (sharp, {13, 14, 15, 16, 17})):
        signal = np.broadcast_to(image, (4, 120, 120)).copy()
        means = without_steep_pixels(averaged(steady_capture(signal, SIGMA), 2))
        assert columns <= set(np.flatnonzero(means.steep[30]).tolist())
        assert means.steep.any() == bool(columns)
        assert means.steep.mean() < 0.2
        assert not (means.usable & means.steep).any()


ANALYZERS = 0.5 * np.array([[1.0, 1, 0], [1, 0, 1], [1, -1, 0], [1, 0, -1]])
LAYOUT = MosaicLayout.of((("90", "45"), ("135", "0")), ("0", "45", "90", "135"), ANALYZERS)
SOLVE = np.linalg.pinv(ANALYZERS)
LIGHT, READ = np.array([4000.0, 600, -300]), 2.3


def test_it_is_the_sum_over_all_pairs_of_a_bin():
    rng = np.random.default_rng(1)
    bins, stderr = rng.integers(-1, 3, size=(9, 7)), rng.uniform(1, 2, size=(9, 7))
    stderr[2, 3] = np.nan
    correlation = rng.uniform(0.1, 0.5, size=(5, 5))
    correlation = (correlation + correlation[::-1, ::-1]) / 2
    correlation[2, 2] = 1
    expected = np.zeros((9, 7))
    for y, x in np.ndindex(9, 7):
        for v, u in np.ndindex(9, 7):
            near = abs(v - y) <= 2 and abs(u - x) <= 2
            if near and bins[y, x] == bins[v, u] >= 0 and np.isfinite(stderr[y, x] * stderr[v, u]):
                expected[y, x] += correlation[2 + v - y, 2 + u - x] * stderr[y, x] * stderr[v, u]
    np.testing.assert_allclose(shared_variance(bins, stderr, correlation), expected)


@pytest.mark.parametrize("method", ["superpixel", "bilinear", "difference", "oriented"])
@pytest.mark.parametrize("block", [(1, 2), (2, 2), (4, 5)])
def test_pulls_of_means_have_unit_variance(method, block):
    size = (160, 200)
    rng = np.random.default_rng(4)
    expected = np.empty(size)
    for level, (r, c) in zip(ANALYZERS @ LIGHT, LAYOUT.offsets, strict=True):
        expected[r::2, c::2] = level
    frame = (rng.poisson(expected) + rng.normal(0, READ, size)).astype(np.float32)
    channels = demosaic(frame, LAYOUT, method)
    s1 = np.tensordot(SOLVE[1], channels, axes=1)
    variance = np.maximum(channels, 0) + np.float32(READ**2)
    stderr = np.sqrt(stokes_covariance(variance, LAYOUT, method, SOLVE, frame=frame)[1])
    correlation = neighbour_correlation(LAYOUT, method, tuple(map(tuple, SOLVE.tolist())))
    y, x = np.indices(s1.shape)
    bins = (y // block[0]) * 1000 + x // block[1]
    shared = shared_variance(bins, stderr, correlation)

    def means(values: np.ndarray) -> np.ndarray:
        blocks = values[: s1.shape[0] // block[0] * block[0], : s1.shape[1] // block[1] * block[1]]
        return blocks.reshape(-1, block[0], blocks.shape[1] // block[1], block[1]).mean(axis=(1, 3))

    pull = (means(s1) - LIGHT[1]) / np.sqrt(means(shared) / (block[0] * block[1]))
    naive = (means(s1) - LIGHT[1]) / np.sqrt(means(stderr**2) / (block[0] * block[1]))
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.1)
    if method != "superpixel":
        assert np.sqrt(np.mean(naive**2)) > 1.2
