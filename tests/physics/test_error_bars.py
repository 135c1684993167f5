"""Every error bar of `process quantities` on five kinds of sample: a short form of `benchmarks/error_bars.py`."""

import numpy as np
import pytest
from error_bars import entries
from noisy_images import five_samples, noisy_image

from processing.maps.quantities import EXTRA, quantities_block
from processing.polarization import mueller, triply_degenerate

PIXELS = 400


@pytest.mark.parametrize("electrons", [20, 200, 20_000])
@pytest.mark.parametrize("sample", five_samples())
def test_pulls_have_unit_variance_where_there_is_an_error_bar(sample, electrons):
    found = list(entries(sample, electrons, PIXELS, EXTRA))
    # Sampling scatters by 0.035 (more where components are few and tails wide); second order is what 20 electrons show.
    room = 0.45 if electrons == 20 else 0.2
    for e in found:
        if e.determined > 0.85:
            assert e.rms == pytest.approx(1, abs=room), e
    # Something must be left of them.
    assert sum(e.determined > 0.85 for e in found) > (6 if electrons == 20 else 15)


def block(matrix: np.ndarray, electrons: float) -> dict[str, np.ndarray]:
    return quantities_block(noisy_image(np.tile(matrix, (PIXELS, 1, 1)), electrons, 2), (), {})


@pytest.mark.parametrize(("axis", "electrons"), [(0.4, 200), (0.4, 20_000), (0.0, 20_000), (np.pi / 2, 200)])
def test_near_180_degrees_the_axis_is_not_determined_but_the_pair_of_axes_is(axis, electrons):
    found = block(triply_degenerate.mueller_matrix(mueller.retarder(axis, np.pi), 0.9), electrons)
    fast, errors = found["retardance_fast_axis_deg"], found["retardance_fast_axis_deg_errors"]
    assert np.std(fast) > 20  # it flips
    # Three errors from 180 degrees by chance: 0.3 %.
    assert np.isfinite(errors).mean() < 0.01
    assert found["retardance_axis_flip"].mean() > 0.1
    # Of the two axes: 0 and 90 degrees are the same.
    apart = (found["retardance_axis_or_90_deg"] - np.rad2deg(axis) + 45) % 90 - 45
    pull = apart / found["retardance_axis_or_90_deg_errors"]
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.15)


def test_farther_from_180_degrees_the_axis_is_determined():
    found = block(triply_degenerate.mueller_matrix(mueller.retarder(0.4, np.deg2rad(170)), 0.9), 20_000)
    pull = (found["retardance_fast_axis_deg"] - np.rad2deg(0.4)) / found["retardance_fast_axis_deg_errors"]
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.15)
    assert found["retardance_axis_flip"].max() < 1e-3


@pytest.mark.parametrize("degrees", [69, 178, 179, 180])
def test_the_joint_region_of_the_retardance_vector_covers_at_180_degrees_too(degrees):
    m = triply_degenerate.mueller_matrix(mueller.retarder(0.4, np.deg2rad(degrees)) @ mueller.rotation(0.2), 0.9)
    found, truth = block(m, 200), block(m, 1e13)["retardance_vector_deg"].reshape(3, -1)[:, :1]
    packed = found["retardance_vector_covariance"].reshape(6, -1)
    covariance = np.moveaxis(packed[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3, -1), -1, 0)
    inverse = np.linalg.inv(covariance.astype(float))
    # The same retarder, turned the other way round.
    same = (truth, truth - 360 * truth / np.linalg.norm(truth))
    errors = [found["retardance_vector_deg"].reshape(3, -1) - vector for vector in same]
    distance = np.min([np.einsum("ip,pij,jp->p", error, inverse, error) for error in errors], axis=0)
    # Chi-square of three degrees of freedom.
    assert np.mean(distance) == pytest.approx(3, abs=0.5)
    assert np.mean(distance < 7.815) == pytest.approx(0.95, abs=0.04)


@pytest.mark.parametrize("degrees", [180, 179, 178])
def test_the_error_bar_of_a_folded_retardance_covers(degrees):
    found = block(triply_degenerate.mueller_matrix(mueller.retarder(0.4, np.deg2rad(degrees)), 0.9), 200)
    off = np.abs(found["retardance_deg"] - degrees) / found["retardance_deg_errors"]
    # At 180 degrees half a normal distribution; half an error and an error away the fold only helps.
    assert np.mean(off < 1) > 0.68 - 3 * np.sqrt(0.68 * 0.32 / PIXELS)
    assert np.mean(off < 1.96) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / PIXELS)


def test_noise_alone_is_taken_off_what_td_misses():
    found = block(triply_degenerate.mueller_matrix(five_samples()["non-depolarizing"], 0.6), 200)
    assert np.median(found["td_missed"]) < 0.3 * np.median(found["td_missed_noise"])
    assert np.isnan(found["td_missed_errors"]).mean() > 0.9
