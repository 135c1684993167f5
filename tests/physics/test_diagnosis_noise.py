"""Noise alone has no excess and no gradient, whatever is done to the counts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtri, ndtr
from steady_capture import steady_capture

from processing.diagnosis.captures.unstated_noise import estimated_noise
from processing.diagnosis.instrument.diagnose import white
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import moments_of
from processing.diagnosis.instrument.projection import add_blocks, noise_information
from processing.diagnosis.instrument.structure import Residual, descriptions, structure_tests
from processing.diagnosis.search.decision import in_deviations
from processing.diagnosis.search.linearization import with_noise_of_counts
from processing.diagnosis.search.space import Sums

STATES, SIDE, SIGMA = 8, 240, 0.01


@pytest.fixture(scope="module")
def noisy():
    """A flat scene of which nothing but noise can move."""
    random = np.random.default_rng(4)
    signal = 0.5 + SIGMA * random.normal(size=(STATES, SIDE, SIDE))
    return steady_capture(signal, SIGMA)


@pytest.mark.parametrize("moved", [False, True])
def test_a_shift_or_a_bend_of_noise_promises_nothing(noisy, moved):
    random = np.random.default_rng(5)
    data = noisy.moved_back(random.uniform(-0.6, 0.6, (STATES, 2))) if moved else noisy
    moments = moments_of(data, 1)
    # Two unknowns: brightness and something else.
    a = np.stack([np.ones(STATES), random.normal(size=STATES)], axis=1) / moments.sigma[:, None]
    c = np.zeros((len(FEATURES), STATES))
    c[0] = 1.0
    c[-DERIVATIVES:] = random.normal(size=(DERIVATIVES, STATES))
    dc = np.zeros((3, len(FEATURES), STATES))
    # A bend of the response: counts of one brightness are stretched alike, and noise with them.
    dc[2, FEATURES.index("log")] = 1.0
    dc[0, FEATURES.index("dx")] = random.normal(size=STATES)
    dc[1, FEATURES.index("dyy")] = random.normal(size=STATES)
    sums, (block,) = Sums.empty(1, 3), moments.blocks
    add_blocks([block], a, c, np.zeros((3, *a.shape)), dc=dc, moments=moments, out=sums)
    # Derivatives share noise with neighbours: the excess varies up to twice as much as with independent values.
    assert abs(sums.excess[0]) < 5 * np.sqrt(2 * 2 * sums.freedom[0])
    error = np.sqrt(np.diag(sums.curvature[0]))
    assert np.all(np.abs(sums.gradient[0]) < 5 * error)
    # All of the curvature is noise.
    part = sum(noise_information(block, a, dc, moments))
    assert part == pytest.approx(sums.curvature[0], rel=0.03, abs=0.03 * np.max(part))


@pytest.mark.parametrize("directions", [6, 24, 3000])
@pytest.mark.parametrize("deviate", [-3.0, 2.0, 5.0])
def test_a_sum_of_squares_is_as_far_off_as_a_normal_variate_that_is_as_unlikely(directions, deviate):
    square = chdtri(directions, ndtr(-deviate))
    tests, _ = in_deviations({"x": (square - directions, np.sqrt(2 * directions), directions)})
    assert tests["x"] == pytest.approx(deviate, abs=0.15)


def test_tests_of_pure_noise_scatter_by_one_standard_deviation():
    """Also where the residuals of one pixel go together, since 16 unknowns of it were projected out."""
    random = np.random.default_rng(6)
    rows, side = 24, 24
    q = np.linalg.qr(random.normal(size=(rows, 16)))[0]
    outside = np.eye(rows) - q @ q.T
    expected = np.broadcast_to(np.diag(outside)[:, None, None], (rows, side, side)).astype(np.float32)
    around = np.broadcast_to(random.uniform(0.5, 1.5, (side, side)), (rows, side, side)).astype(np.float32)
    scores = []
    for _ in range(100):
        residual = np.tensordot(outside, random.normal(size=(rows, side, side)), 1).astype(np.float32)
        noise = {"shown": np.ones(rows), "alike": np.zeros((rows, 2)), "columns": 16, "spread": 1.0}
        tests, _ = structure_tests(residual, around, expected, np.ones((side, side), dtype=bool), **noise)
        scores.append([value for name, value in tests.items() if name != "sum of squares"])
    assert len(scores[0]) == 5
    assert np.std(scores, axis=0) == pytest.approx(np.ones(5), abs=0.25)


def test_noise_of_light_is_told_where_the_sample_shows_few_of_its_elements(rgb950):
    """Of 16 directions over the states ten hold noise alone, most of it that of bright pixels."""
    random, states, side, electrons = np.random.default_rng(9), 40, 44, 50_000.0
    turned = 9.0 * np.arange(states)
    rows = rgb950.rows({"psg": turned, "psa": 4.91 * turned}).reshape(states, 16)
    m = np.zeros((16, side, side))
    m[0] = np.exp(random.normal(size=(side, side)) - 3)
    m[[1, 4, 5, 10, 15]] = m[0] * random.uniform(-0.3, 0.3, (5, side, side))
    light = np.tensordot(rows, m, 1)
    read = 0.03 * light.mean() / electrons
    noise = random.normal(0, np.sqrt(read), light.shape)
    estimate = estimated_noise(steady_capture(random.poisson(electrons * light) / electrons + noise, 0.0))
    assert estimate.slope[0] * electrons == pytest.approx(1, abs=0.02)
    assert estimate.floor[0] == pytest.approx(read, rel=0.1)


def test_what_captures_leave_over_is_told_with_their_names():
    """Of two captures the same sentences stood there twice, and nothing said which was whose."""

    def left(excess: float) -> Residual:
        none = np.zeros(3)
        image = np.zeros((3, 2, 2), np.float32)
        return Residual(image, none, np.array([0.0, 2.0, 1.0]), {"sum of squares": excess}, {}, {}, none, 0.0)

    assert descriptions(["a.h5"], [left(11.0)])[0] == "sum of squares: 11 standard deviations above noise"
    assert descriptions(["a.h5", "b.h5", "c.h5"], [left(11.0), left(0.0), left(12.0)]) == (
        "a.h5: sum of squares: 11 standard deviations above noise",
        "a.h5: states that are furthest off on average: 1, 2, 0",
        "c.h5: sum of squares: 12 standard deviations above noise",
        "c.h5: states that are furthest off on average: 1, 2, 0",
    )


def test_a_gradient_that_varies_more_leaves_the_minimum_and_widens_its_error():
    random = np.random.default_rng(8)
    root, noisy = random.normal(size=(5, 9)), random.normal(size=(5, 2)) * np.array([0, 1, 0, 1, 0])[:, None]
    curvature, variance, gradient = root @ root.T, noisy @ noisy.T, random.normal(size=5)
    g, h = with_noise_of_counts(gradient, curvature, variance)
    inverse = np.linalg.inv(curvature)
    assert np.linalg.solve(h, g) == pytest.approx(inverse @ gradient)
    assert np.linalg.inv(h) == pytest.approx(inverse @ (curvature + variance) @ inverse)


def test_opposite_channels_of_a_state_are_no_course_over_the_states():
    """Of two channels whose level is projected out one has what the other lacks."""
    random = np.random.default_rng(8)
    residual = Residual(np.zeros((128, 1, 1)), np.zeros(128), np.zeros(128), {}, {}, {}, np.zeros(128), 0.0)
    seen = []
    for course in (0.0, 3.0):
        left = random.normal(size=(200, 64)) + course * np.sin(np.arange(64) / 6)
        mean = np.stack([left, -left], axis=2).reshape(200, 128)
        seen.append(np.mean([not white(replace(residual, mean=each), channels=2) for each in mean]))
    assert seen[0] == 0
    assert seen[1] > 0.5
