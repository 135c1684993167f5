"""Intervals of lengths, directions, eigenvalues and singular values of noise that is drawn, without an image."""

import numpy as np
import pytest
from eigenvalue_table import blocks, deviations, eigenvalues, products, singular_values
from magnitude_table import node
from noisy_images import nineteen_samples, noisy_image, seven_instruments

from processing.maps.quantities import quantities_block
from processing.polarization.magnitude import (
    ALONG,
    COMPONENTS,
    TABLE,
    directions,
    interval,
    positive,
)
from processing.polarization.quantities import PAPER_PAIRS
from processing.polarization.sorted_eigenvalues import OF_MEAN, of_gaps, of_singular_values
from processing.polarization.vector_noise import of_slopes


@pytest.mark.parametrize("components", [1, 2, 3, 6, 15])
@pytest.mark.parametrize("length", [0.0, 0.7, 2.0, 5.0, 14.0])
def test_an_interval_of_a_length_covers_at_every_length(components: int, length: float) -> None:
    noise = np.random.default_rng(components).normal(size=(4000, components))
    noise[:, 0] += length
    lengths = np.linalg.norm(noise, axis=1)
    intervals = interval(
        lengths, np.ones_like(lengths), np.full_like(lengths, components), np.full_like(lengths, components)
    )
    assert np.mean((intervals.low <= length) & (length <= intervals.high)) == pytest.approx(0.95, abs=0.017)
    assert np.mean(np.abs(intervals.value - length) <= intervals.error) == pytest.approx(0.69, abs=0.05)


def test_a_long_vector_with_little_noise_along_it_has_its_own_error() -> None:
    """That of a polarizer's diattenuation was more than half of the noise across it, and covered 100 %."""
    noise = np.random.default_rng(1).normal(size=(2, 20_000)) * [[0.1], [1.0]]
    lengths, unit = np.hypot(50 + noise[0], noise[1]), np.ones(20_000)
    intervals = interval(lengths, 0.01 * unit, 1.01 * unit, 1.0001 * unit)
    assert np.mean(np.abs(intervals.value - 50) <= intervals.error) == pytest.approx(0.683, abs=0.02)


@pytest.mark.parametrize("instrument", ["127 degrees, 9 to 1, 41", "24 others"])
@pytest.mark.parametrize(("length", "off_68", "off_95"), [(2.0, 0.1, 0.03), (3.0, 0.09, 0.03), (6.0, 0.06, 0.03)])
def test_a_length_covers_whatever_the_directions_of_the_noise(
    instrument: str, length: float, off_68: float, off_95: float
) -> None:
    """Of lengths of two to six noises 68 and 95 % intervals covered 78 to 89 and 98 to 99 %."""
    inverse, count, random = np.linalg.pinv(seven_instruments()[instrument]), 8000, np.random.default_rng(14)
    covariance = inverse @ inverse.T
    covariance[0] = covariance[:, 0] = 0
    covariance *= np.trace(covariance) / np.trace(covariance @ covariance)
    true = random.normal(size=(15, 40))
    true = np.repeat(length * true / np.linalg.norm(true, axis=0), count // 40, axis=1)
    vector = true + np.linalg.cholesky(covariance[1:, 1:]) @ random.normal(size=(15, count))
    slopes = np.broadcast_to(np.eye(16)[1:, None], (15, count, 16))
    noise = of_slopes(np.broadcast_to(covariance, (count, 16, 16)), vector, slopes)
    found = interval(np.linalg.norm(vector, axis=0), *noise[:3], plane=noise[3:6])
    assert np.mean(np.abs(found.value - length) <= found.error) == pytest.approx(0.683, abs=off_68)
    assert np.mean((found.low <= length) & (length <= found.high)) == pytest.approx(0.95, abs=off_95)


def test_a_narrow_interval_covers_where_noise_turned_the_vector_to_a_quiet_direction():
    """Noise hides what the vector has across: of the narrow intervals 58 % covered, and their errors were too small."""
    sample = nineteen_samples()["triply degenerate"]
    image = noisy_image(np.repeat(sample[None], 3000, axis=0), 2000, [5, 1], seven_instruments()["24 others"])
    planes = quantities_block(image, (), PAPER_PAIRS)
    low, high = planes["depolarization_index_95"].reshape(2, -1)
    error = planes["depolarization_index_errors"].ravel()
    truth = np.sqrt((np.sum((sample / sample[0, 0]) ** 2) - 1) / 3)
    is_narrow = error < 0.3 * np.median(error)
    assert np.mean((low <= truth) & (truth <= high)) == pytest.approx(0.95, abs=0.02)
    assert is_narrow.mean() < 0.08
    assert np.mean(((low <= truth) & (truth <= high))[is_narrow]) > 0.75


@pytest.mark.parametrize(("components", "off_68", "off_95"), [(8.0, 0.04, 0.025), (1.5, 0.05, 0.03)])
@pytest.mark.parametrize("gaps", [(0, 0), (1, 0), (0.5, 3), (3, 0), (2, 2), (8, 2), (30, 0), (0, 30)])
def test_intervals_of_eigenvalues_cover_at_every_gap(
    gaps: tuple[float, float], components: float, off_68: float, off_95: float
) -> None:
    """Noise pushes equal ones apart: with errors to first order 68 % intervals of the sphere's covered 80 %."""
    random = np.random.default_rng(3)
    values, noise = (part.T for part in eigenvalues(*gaps, random, blocks(components, random, 10_000)))
    intervals = of_gaps(values[0] - values[1], values[1] - values[2], noise, components)
    mean = random.normal(0, np.sqrt(OF_MEAN), 10_000)
    off = values + intervals.middle + mean - deviations(*gaps)[:, None]
    in_68, in_95 = np.abs(off) <= intervals.half, (off <= intervals.below) & (off >= -intervals.above)
    assert in_68.mean(axis=1) == pytest.approx(np.full(3, 0.68), abs=off_68)
    assert in_95.mean(axis=1) == pytest.approx(np.full(3, 0.95), abs=off_95)


@pytest.mark.parametrize(("components", "off_68", "off_95"), [(8.0, 0.05, 0.035), (1.5, 0.08, 0.04)])
@pytest.mark.parametrize("true", [(0, 0, 0), (30, 30, 30), (30, 30, -30), (3, 3, 0), (8, 2, 1), (30, 20, 10)])
def test_intervals_of_singular_values_cover_at_every_gap(
    true: tuple[float, ...], components: float, off_68: float, off_95: float
) -> None:
    """Those of equal ones covered 97 to 100 %, with a bias of their own error."""
    random = np.random.default_rng(3)
    values, noise = (part.T for part in singular_values(np.array(true), random, blocks(components, random, 10_000, 9)))
    intervals = of_singular_values(values, noise, np.ones(10_000), components)
    off = values + intervals.middle - np.array(true)[:, None]
    in_68, in_95 = np.abs(off) <= intervals.half, (off <= intervals.below) & (off >= -intervals.above)
    assert in_68.mean(axis=1) == pytest.approx(np.full(3, 0.68), abs=off_68)
    assert in_95.mean(axis=1) == pytest.approx(np.full(3, 0.95), abs=off_95)


@pytest.mark.parametrize("true", [(0, 0, 0), (30, 30, 30)])
def test_noise_of_analyzers_and_generators_is_not_alike_in_all_singular_values(true: tuple[float, ...]) -> None:
    """Its directions are outer products: of three zeros the smallest covered 86 and 100 %."""
    random = np.random.default_rng(3)
    values, noise = (part.T for part in singular_values(np.array(true), random, products(4.0, random, 10_000)))
    intervals = of_singular_values(values, noise, np.ones(10_000), 4.0)
    off = values + intervals.middle - np.array(true)[:, None]
    in_68, in_95 = np.abs(off) <= intervals.half, (off <= intervals.below) & (off >= -intervals.above)
    assert in_68.mean(axis=1) == pytest.approx(np.full(3, 0.68), abs=0.1)
    assert in_95.mean(axis=1) == pytest.approx(np.full(3, 0.95), abs=0.045)


def test_the_table_of_intervals_is_what_its_program_makes() -> None:
    with np.load(TABLE) as stored:
        assert stored["lengths"].shape[:2] == (len(COMPONENTS), len(ALONG))
        np.testing.assert_allclose(stored["lengths"][4, 5], node(COMPONENTS[4], ALONG[5]), atol=1e-5)


@pytest.mark.parametrize("covariance", [(1.0, 1.0, 0.0), (1.0, 0.04, 0.1), (0.02, 1.0, -0.1)])
@pytest.mark.parametrize("length", [0.3, 1.0, 3.0, 8.0])
def test_a_direction_covers_at_every_length_under_any_noise(length: float, covariance: tuple[float, ...]) -> None:
    xx, yy, xy = covariance
    noise = np.linalg.cholesky([[xx, xy], [xy, yy]]) @ np.random.default_rng(4).normal(size=(2, 20_000))
    vector = noise + np.array([[0.8 * length], [0.6 * length]])
    intervals = directions(vector, np.array(covariance)[:, None] * np.ones(20_000))
    off = np.arctan2(0.6, 0.8) - np.arctan2(*vector[::-1])
    off -= 2 * np.pi * np.round(off / (2 * np.pi))
    # All directions where the vector may be zero: then more often.
    assert np.mean((intervals.low <= off) & (off <= intervals.high)) > 0.945
    if length == 8:
        assert np.mean((intervals.low <= off) & (off <= intervals.high)) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("true", [0.0, 0.3, 1.0, 3.0, 6.0])
def test_an_interval_of_what_is_not_negative_covers(true: float) -> None:
    values = true + np.random.default_rng(5).normal(size=40_000)
    for number, level in enumerate((0.683, 0.95)):
        low, high = (positive(values, number, end) for end in (0, 1))
        assert np.mean((low <= true) & (true <= high)) == pytest.approx(level, abs=0.01)
