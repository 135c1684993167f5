"""xi0 and the small eigenvalues under Poisson and read noise: no bias, intervals that cover, an even mask."""

import numpy as np
import pytest
from noisy_images import five_samples, noisy_image, rgb950

from processing.maps.coherency_noise import largest_deviation_by_noise
from processing.maps.xi0 import eigenvalue_block
from processing.polarization import mueller, triply_degenerate
from processing.polarization.cloude import coherency_eigenvalues
from processing.polarization.eigenvalue_noise import THETA, EigenvalueNoise, corrected
from processing.polarization.quantities import deviation_from_td

PIXELS = 2500
PURE = five_samples()["non-depolarizing"]


def blocks(matrix: np.ndarray, electrons: float, seed: int = 5) -> dict[str, np.ndarray]:
    return eigenvalue_block(noisy_image(np.tile(matrix, (PIXELS, 1, 1)), electrons, seed))


@pytest.mark.parametrize("electrons", [20, 200, 20_000])
@pytest.mark.parametrize("truth", [0.25, 0.255, 0.3, 0.4, 0.5, 0.7, 1.0])
def test_intervals_of_a_triply_degenerate_matrix_cover(truth, electrons):
    found = blocks(triply_degenerate.mueller_matrix(PURE, truth), electrons)
    # Sampling makes 0.013 and 0.006; noise that is not alike in all directions leaves the rest (docs/quantities.md).
    for name, level, below in (("xi0_68", 0.683, 0.065), ("xi0_95", 0.95, 0.035)):
        low, high = found[name].reshape(2, -1)
        assert level - below < np.mean((low <= truth) & (truth <= high)) < level + 0.04, name
    # Nothing is left out because of what came out.
    assert found["valid"].all()
    quoted = np.median(found["xi0_errors"])
    assert abs(np.mean(found["xi0"]) - truth) < 0.5 * quoted
    if truth >= 0.4:
        assert np.median(found["xi0"]) == pytest.approx(truth, abs=0.15 * quoted)
    # One number for either side, where the interval is lopsided too: half of it had pulls of rms 2 near 1/4.
    pull = np.abs(found["xi0"] - truth) / found["xi0_errors"]
    # Where xi0 leaves the noise of 1/4 the interval is longest against the scatter: 0.8.
    assert 0.78 < np.sqrt(np.mean(pull**2)) < 1.08
    assert np.mean(pull < 1) > 0.683 - 0.03
    assert np.mean(pull < 1.96) > 0.95 - 0.03


@pytest.mark.parametrize("truth", [0.25, 0.3])
def test_intervals_near_a_quarter_are_wide_where_one_direction_is_noisier(truth):
    # Two plates of 127 degrees at 9 to 1: condition number 26, one direction has 12 times the usual variance.
    states = np.deg2rad(4.7) * np.arange(41)
    generator = mueller.retarder(states, np.deg2rad(127)) @ np.array([1.0, 1, 0, 0]) / 2
    analyzer = np.array([1.0, -1, 0, 0]) / 2 @ mueller.retarder(9 * states, np.deg2rad(127))
    w = np.einsum("ni,nj->nij", analyzer, generator).reshape(-1, 16)
    random = np.random.default_rng(3)
    samples = [PURE, mueller.retarder(0.3, 1.0), mueller.retarder(1.2, 2.5) @ mueller.retarder(0.4, 2.0)]
    matrices = np.stack([triply_degenerate.mueller_matrix(samples[k], truth) for k in random.integers(3, size=PIXELS)])
    found = eigenvalue_block(noisy_image(matrices, 500, 5, w))
    # Half of the 68 % and 60 of the 95 % before; what is missing still is told in docs/quantities.md.
    for name, least in (("xi0_68", 0.6), ("xi0_95", 0.8)):
        low, high = found[name].reshape(2, -1)
        assert np.mean((low <= truth) & (truth <= high)) > least, name


@pytest.mark.parametrize("electrons", [200, 20_000])
@pytest.mark.parametrize("name", five_samples())
def test_pulls_of_five_kinds_of_sample(name, electrons):
    matrix = five_samples()[name]
    truth = coherency_eigenvalues(matrix[None])[0, 0]
    found = blocks(matrix, electrons)
    pull = (found["xi0"] - truth) / found["xi0_errors"]
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.07)
    assert abs(np.mean(pull)) < 0.1


@pytest.mark.parametrize("electrons", [20, 200, 20_000])
def test_noise_alone_is_told_and_taken_off_the_spread_of_eigenvalues(electrons):
    degenerate = blocks(triply_degenerate.mueller_matrix(PURE, 0.6), electrons)
    raw = degenerate["eigenvalues"][1:].reshape(3, -1)
    rms = np.sqrt(np.mean(np.sum((raw - raw.mean(axis=0)) ** 2, axis=0)))
    assert np.median(degenerate["eigenvalue_spread_noise"]) == pytest.approx(rms, rel=0.06)
    assert np.median(degenerate["eigenvalue_spread"]) < 0.3 * rms


@pytest.mark.parametrize("electrons", [200, 20_000])
def test_the_largest_deviation_by_noise_alone_has_its_distribution(electrons):
    image = noisy_image(np.tile(triply_degenerate.mueller_matrix(PURE, 0.6), (PIXELS, 1, 1)), electrons, 3)
    measured = np.abs(deviation_from_td(coherency_eigenvalues(image.matrices))).max(axis=-1)
    alone = largest_deviation_by_noise(image)
    for percent in (50, 99):
        assert np.percentile(alone, percent) == pytest.approx(np.percentile(measured, percent), rel=0.1)


def test_a_real_spread_stays():
    matrix = five_samples()["diagonal depolarizer"]
    xi = coherency_eigenvalues(matrix[None])[0, 1:]
    truth = np.sqrt(np.sum((xi - xi.mean()) ** 2))
    for electrons in (200, 20_000):
        assert np.median(blocks(matrix, electrons)["eigenvalue_spread"]) == pytest.approx(truth, rel=0.05)


def test_the_weighted_estimate_has_the_same_noise_within_its_weights():
    image = noisy_image(np.tile(PURE, (50, 1, 1)), 200, 1)
    full = image.covariance()
    form = np.einsum("a,bk->abk", np.ones(16), np.eye(16))
    form = form + form.swapaxes(0, 1)
    gradient = np.random.default_rng(0).normal(size=(1, 50, 16))
    expected = np.einsum("rpab,abk,rpk->rp", full, form, gradient)
    np.testing.assert_allclose(image.product_of(form, gradient), expected, rtol=0.02)


def test_far_above_the_noise_the_table_goes_on_smoothly():
    even = np.full(400, 0.01)
    noise = EigenvalueNoise(even * np.sqrt(0.75), even, np.zeros(400), even)
    xi0 = np.linspace(0.25, 0.25 + 0.75 * 0.01 * (THETA[-1] + 4), 400)
    rest = (1 - xi0) / 3
    found = corrected(np.stack([xi0, rest, rest, rest], axis=-1), noise)
    for values in (found.xi0, *found.interval_68, *found.interval_95):
        steps = np.diff(values)
        assert np.all(steps > 0)
        assert steps[-100:].max() < 1.5 * steps[-100:].min()


def test_without_errors_nothing_is_taken_off():
    image = noisy_image(np.tile(PURE, (4, 1, 1)), 200, 1, rgb950())
    unknown = np.full_like(image.errors, np.nan)
    found = eigenvalue_block(type(image)(**(vars(image) | {"errors": unknown})))
    np.testing.assert_allclose(found["xi0"], found["eigenvalues"][0])
    assert not found["valid"].any()
