"""Every error bar of `process quantities` and `process xi0`: the short form of `benchmarks/error_bars.py`."""

from functools import cache

import numpy as np
import pytest
from error_bars import Cell, cells, verdicts
from noisy_images import nineteen_samples, noisy_image, seven_instruments

from processing.maps.quantities import EXTRA, quantities_block
from processing.polarization import mueller, triply_degenerate
from processing.polarization.magnitude import (
    interval,
    sum_of_singular_values,
)
from processing.polarization.quantities import PAPER_PAIRS

PIXELS = 300
NOTHING_POLARIZED = ("ideal depolarizer", "nearly ideal depolarizer", "air")
#: Three standard deviations of a part of PIXELS, below the limits of docs/studies/error-bars.md.
LEAST_68, LEAST_95 = 0.64 - 3 * np.sqrt(0.68 * 0.32 / PIXELS), 0.93 - 3 * np.sqrt(0.95 * 0.05 / PIXELS)


@cache
def shared_cells(
    instrument: str,
    darks: int,
    electrons: float,
    pixels: int,
    samples: tuple[str, ...] = (),
    extra: tuple[str, ...] = (),
) -> list[Cell]:
    """Cells of several tests, each of which looks at one quantity."""
    return list(cells(instrument, darks, electrons, pixels, samples=samples, extra=extra))


@pytest.mark.parametrize(("electrons", "darks"), [(200, 0), (20_000, 1)])
def test_every_interval_covers_for_every_sample(electrons: float, darks: int) -> None:
    table = shared_cells("RGB950's 40", darks, electrons, PIXELS, extra=EXTRA)
    low = [c for c in table if c.in_95 < LEAST_95 or c.in_68 < LEAST_68]
    # 800 cells: two in a thousand are beyond three standard deviations by chance.
    assert len(low) <= 4, low
    assert all(c.in_95 > 0.85 for c in table), min(table, key=lambda c: c.in_95)
    assert {c.has_interval for c in table} == {1.0}
    # Errors to first order covered 80 and 84 %.
    for name in ("coherency_eigenvalues", "eigenvalue_deviation"):
        assert 0.64 <= np.median([c.in_68 for c in table if c.quantity == name]) <= 0.72


@pytest.mark.parametrize("name", ["diattenuation", "polarizance_purity", "depolarization_index", "mueller"])
def test_where_nothing_is_polarized_intervals_hold_as_often_as_they_claim(name: str) -> None:
    for cell in shared_cells("RGB950's 40", 0, 200, 1500, NOTHING_POLARIZED):
        if cell.quantity == name:
            # The noise of the 15 elements is not quite alike in all directions, which the interval does not know.
            assert 0.63 < cell.in_68 < 0.76, cell
            assert 0.92 < cell.in_95 < 0.98, cell


def test_depolarization_power_of_a_depolarizer_has_no_bias() -> None:
    table = shared_cells("RGB950's 40", 0, 200, 1500, NOTHING_POLARIZED)
    (cell,) = (c for c in table if (c.quantity, c.sample) == ("depolarization_power", "ideal depolarizer"))
    # Its 95 % interval covered 28 %, and the mean pull was -2.35.
    assert cell.in_95 > 0.93
    assert abs(cell.mean) < 1


@pytest.mark.parametrize("extinction", [100, 1000, 10_000])
def test_a_polarizer_has_no_retardance_with_a_narrow_interval(extinction: int) -> None:
    matrix = nineteen_samples()[f"polarizer 1:{extinction}"]
    maps = quantities_block(noisy_image(np.tile(matrix, (PIXELS, 1, 1)), 200, 2), (), {})
    low, high = maps["retardance_deg_95"]
    # 7 to 17 % of the pixels said 176 +- 7 degrees.
    assert np.mean(low > 1) < 0.05
    assert np.nanmedian(high - low) > 90


def test_a_mean_of_darks_is_one_error_of_m00() -> None:
    matrix = nineteen_samples()["triply degenerate"]
    truth = quantities_block(noisy_image(matrix[None], 1e13, 0), (), {})["depolarization_index"]
    image = noisy_image(np.tile(matrix, (1500, 1, 1)), 1000, 3, darks=1, read_noise_e=30)
    maps = quantities_block(image, (), {})
    pull = (maps["depolarization_index"] - truth) / maps["depolarization_index_errors"]
    # It was 1.67.
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize("quantity", ["symmetric_d1", "symmetric_d2", "symmetric_d3", "eigenvalue_deviation"])
def test_sorted_numbers_have_intervals_and_pulls_within_the_limits(quantity: str) -> None:
    """Elements of the symmetric decomposition covered 96 to 100 %; pulls of deviations over an even error were 1.3."""
    rows = [c for c in shared_cells("RGB950's 40", 1, 20_000, PIXELS, extra=EXTRA) if c.quantity == quantity]
    assert len(rows) >= 12
    # The smallest of three equal ones covers 97 to 98 %.
    assert sum(verdicts(c, PIXELS)[:2] == ("in", "in") for c in rows) >= 9
    assert not any("low" in verdicts(c, PIXELS) for c in rows)
    # Known to 0.04 each.
    assert all(0.65 < c.rms < 1.2 for c in rows)


def test_noise_of_few_directions_is_no_larger_for_what_it_turned() -> None:
    """The smallest element of an ideal depolarizer covered 92 and 100 %, by the errors of what noise had turned."""
    table = cells("24 random states", 1, 2000, 1000, samples=["ideal depolarizer"], extra=("symmetric",))
    found = [c for c in table if c.quantity.startswith("symmetric_")]
    assert len(found) == 3
    assert all(0.64 < c.in_68 < 0.78 and c.in_95 > 0.94 for c in found), found


@pytest.mark.parametrize(("electrons", "sample"), [(2000, "det < 0"), (200, "polarizer 1:10")])
def test_noise_across_a_short_vector_is_no_error_of_its_length(electrons: float, sample: str) -> None:
    """The error was 0.55 of the noise across at least: 68 % intervals covered 98 %, and pulls were 0.33."""
    table = cells("127 degrees, 9 to 1, 41", 1, electrons, 1000, samples=[sample], extra=())
    cell = next(c for c in table if c.quantity == "depolarization_index")
    assert 0.6 < cell.in_68 < 0.9
    assert cell.rms > 0.6


def test_depolarization_power_holds_with_noise_of_one_direction() -> None:
    """Noise was taken as alike in all directions: the intervals covered 98 and 100 %, and 57 and 84 %."""
    samples = ("ideal depolarizer", "nearly ideal depolarizer")
    table = shared_cells("127 degrees, 9 to 1, 41", 1, 200, 1500, samples)
    for cell in (c for c in table if c.quantity == "depolarization_power"):
        assert 0.64 < cell.in_68 < 0.82, cell
        assert 0.93 < cell.in_95 < 0.99, cell


def test_noise_of_what_is_missed_has_no_more_directions_than_it_shows() -> None:
    """It had as many directions in each pixel as on average: 95 % intervals of `td_missed` covered 86 to 88 %."""
    (cell,) = (c for c in cells("24 others", 1, 2000, 1500, samples=["det < 0"], extra=()) if c.quantity == "td_missed")
    assert cell.in_95 > 0.9, cell


def test_entropy_allows_for_a_pattern_that_noise_hides() -> None:
    """Small eigenvalues that do not differ beyond noise counted as equal: 95 % intervals covered 87 and 90 %."""
    for instrument, least in (("RGB950's 40 at 451 nm", 0.91), ("two plates of 90 degrees, 5 to 1, 30", 0.95)):
        table = cells(instrument, 0, 20, 1500, samples=["det < 0"], extra=())
        assert next(c.in_95 for c in table if c.quantity == "entropy") > least


def test_an_error_does_not_depend_on_the_other_pixels() -> None:
    """Where no pixel of a block has a differential decomposition its errors were NaN, and infinite in other blocks."""
    samples = nineteen_samples()
    stack = np.repeat(np.stack([samples["retarder 180"], samples["diagonal depolarizer"]]), 60, axis=0)
    image = noisy_image(stack, 20, 3)
    together, alone = (quantities_block(each, EXTRA, {}) for each in (image, image.at(np.arange(60))))
    for name, plane in alone.items():
        np.testing.assert_allclose(plane[..., 0], together[name][..., 0, :60], rtol=1e-3, atol=1e-4, err_msg=name)


def test_over_an_intensity_below_zero_a_length_has_no_interval() -> None:
    # Noise in the dark makes S0 or m00 negative. Whatever the other pixels show, such a pixel shows nothing.
    observed, unit = np.array([-40.0, -3.0, -1e-3, 0.0, 2.0]), np.ones(5)
    lengths = interval(observed, unit, 2 * unit, 2 * unit)
    for bound in (*lengths, *sum_of_singular_values(observed, unit, unit, 4.0)):
        assert np.isnan(bound[:3]).all()
        assert np.isfinite(bound[3:]).all()


def block(matrix: np.ndarray, electrons: float) -> dict[str, np.ndarray]:
    return quantities_block(noisy_image(np.tile(matrix, (PIXELS, 1, 1)), electrons, 2), (), {})


@pytest.mark.parametrize(("axis", "electrons"), [(0.4, 200), (0.4, 20_000), (0.0, 20_000), (np.pi / 2, 200)])
def test_near_180_degrees_the_axis_is_not_determined_but_the_pair_of_axes_is(axis: float, electrons: float) -> None:
    maps = block(triply_degenerate.mueller_matrix(mueller.retarder(axis, np.pi), 0.9), electrons)
    assert np.std(maps["retardance_fast_axis_deg"]) > 20  # it flips
    low, high = maps["retardance_fast_axis_deg_95"]
    assert np.mean(high - low > 170) > 0.9
    assert maps["retardance_axis_flip"].mean() > 0.1
    # Of the two axes: 0 and 90 degrees are the same.
    apart = (maps["retardance_axis_or_90_deg"] - np.rad2deg(axis) + 45) % 90 - 45
    pull = apart / maps["retardance_axis_or_90_deg_errors"]
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.15)


def test_farther_from_180_degrees_the_axis_is_determined() -> None:
    maps = block(triply_degenerate.mueller_matrix(mueller.retarder(0.4, np.deg2rad(170)), 0.9), 20_000)
    pull = (maps["retardance_fast_axis_deg"] - np.rad2deg(0.4)) / maps["retardance_fast_axis_deg_errors"]
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.15)
    assert maps["retardance_axis_flip"].max() < 1e-3


@pytest.mark.parametrize("degrees", [69, 178, 179, 180])
def test_the_joint_region_of_the_retardance_vector_covers_at_180_degrees_too(degrees: float) -> None:
    m = triply_degenerate.mueller_matrix(mueller.retarder(0.4, np.deg2rad(degrees)) @ mueller.rotation(0.2), 0.9)
    maps, truth = block(m, 200), block(m, 1e13)["retardance_vector_deg"].reshape(3, -1)[:, :1]
    packed = maps["retardance_vector_covariance"].reshape(6, -1)
    covariance = np.moveaxis(packed[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3, -1), -1, 0)
    inverse = np.linalg.inv(covariance.astype(float))
    # The same retarder, turned the other way round.
    aliases = (truth, truth - 360 * truth / np.linalg.norm(truth))
    errors = [maps["retardance_vector_deg"].reshape(3, -1) - vector for vector in aliases]
    distance = np.min([np.einsum("ip,pij,jp->p", error, inverse, error) for error in errors], axis=0)
    # Chi-square of three degrees of freedom.
    assert np.mean(distance) == pytest.approx(3, abs=0.5)
    assert np.mean(distance < 7.815) == pytest.approx(0.95, abs=0.04)


def test_noise_alone_is_taken_off_what_td_misses() -> None:
    maps = block(triply_degenerate.mueller_matrix(nineteen_samples()["non-depolarizing"], 0.6), 200)
    assert np.median(maps["td_missed"]) < 0.4 * np.median(maps["td_missed_noise"])
    assert np.mean(maps["td_missed_95"][0] == 0) > 0.9


@pytest.mark.parametrize("quantity", ["diattenuation_linear", "diattenuation", "depolarization_index", "entropy"])
def test_noise_that_differs_between_directions_is_known(quantity: str) -> None:
    """With states of condition 80 the covariance left out m00, and 68 and 95 % intervals covered 58 and 84 to 90 %."""
    samples = ("mirror-like", "det < 0", "DoLP 0.2", "triply degenerate")
    table = shared_cells("24 others", 0, 20_000, 1000, samples)
    rows = [cell for cell in table if cell.quantity == quantity]
    assert len(rows) == 4
    assert min(cell.in_68 for cell in rows) > 0.6
    assert min(cell.in_95 for cell in rows) > 0.915


def test_entropy_of_pure_samples_covers_not_much_too_often() -> None:
    """Noise of poor states grows along the index: the 68 % interval took the wider unit and covered 84 %."""
    pure = ("mirror", "air", "polarizer 1:10")
    covered = [c.in_68 for c in shared_cells("127 degrees, 9 to 1, 41", 1, 60, 1000, pure) if c.quantity == "entropy"]
    assert np.mean(covered) < 0.8
    assert min(covered) > 0.64


def test_entropy_next_to_a_pure_sample_has_the_noise_of_the_index_once() -> None:
    """A part of it counted as noise beside the index: 68 % intervals of retarders covered 80 to 82 %."""
    samples = ["retarder 90", "retarder 178"]
    table = cells("60 and 150 degrees, 4.3 to 1, 36", 1, 200, 1000, samples=samples, extra=())
    found = [c for c in table if c.quantity == "entropy"]
    assert len(found) == 2
    assert all(0.64 < c.in_68 < 0.76 and c.in_95 > 0.93 for c in found), found


@pytest.mark.parametrize(("instrument", "electrons"), [("RGB950's 40", 2000), ("24 others", 60)])
def test_entropy_covers_at_both_its_ends_and_where_an_eigenvalue_may_be_zero(instrument: str, electrons: float) -> None:
    """95 % intervals covered 87 to 89 %; a pure sample's estimate was above the truth by its error."""
    rows = [c for c in cells(instrument, 0, electrons, 400, extra=(), first_seed=21) if c.quantity == "entropy"]
    assert len(rows) == 19
    assert min(cell.in_95 for cell in rows) > 0.95 - 4 * np.sqrt(0.95 * 0.05 / 400)
    # Where the interval is everything the pulls are smaller.
    assert electrons == 60 or np.median([cell.rms for cell in rows]) == pytest.approx(1, abs=0.1)


def test_intervals_of_the_dominant_process_are_not_too_long() -> None:
    """The median of the 68 % intervals covered 79 %."""
    samples = ["air", "mirror", "retarder 2", "retarder 90", "retarder 180"]
    found = cells("60 and 150 degrees, 4.3 to 1, 36", 4, 60, 400, samples=samples, extra=())
    table = [c for c in found if c.quantity.startswith("dominant_") and c.all_95 < 0.05]
    assert len(table) > 20
    assert 0.64 < np.median([c.in_68 for c in table]) < 0.75
    assert min(c.in_95 for c in table) > 0.88


def test_a_dominant_polarizer_has_no_interval_that_always_covers() -> None:
    """Noise does not pass a diattenuation of 1: 95 % intervals about the value covered 99.2 and 99.7 %."""
    found = cells("RGB950's 40", 1, 60, 1000, samples=["polarizer 1:1000"], extra=(), first_seed=9107)
    table = [c for c in found if c.quantity.startswith("dominant_") and c.quantity.endswith("_linear")]
    assert len(table) == 2
    assert all(0.65 < c.in_68 < 0.72 and 0.935 < c.in_95 < 0.985 for c in table), table


def test_a_quiet_element_of_the_dominant_process_has_its_own_second_order() -> None:
    """It had that of the noisiest one: pulls of 0.67 to 0.78, and 95 % intervals covered 99.5 to 99.8 %."""
    samples = ["non-depolarizing", "air", "retarder 180"]
    found = cells("two plates of 90 degrees, 5 to 1, 30", 1, 20, 1000, samples=samples, extra=(), first_seed=9107)
    table = [c for c in found if c.quantity == "dominant_diattenuation_circular"]
    assert len(table) == 3
    assert all(c.rms > 0.8 for c in table), table


def test_orientations_of_the_dominant_process_have_68_percent_intervals_of_their_own() -> None:
    """With the covariance of the 95 % interval they covered 76 and 79 %."""
    found = cells("24 random states", 4, 20_000, 3000, samples=["det < 0"], extra=())
    table = [c for c in found if c.quantity.startswith("dominant_") and c.quantity.endswith("_orientation_deg")]
    assert len(table) == 2
    assert all(0.65 < c.in_68 < 0.74 and c.in_95 > 0.93 for c in table), table


def test_an_axis_that_is_not_determined_has_its_whole_period_about_its_value() -> None:
    """That of the differential decomposition had 0 to 180 degrees, which counts as a miss where it passes 180."""
    table = cells("127 degrees, 9 to 1, 41", 0, 60, 200, samples=["retarder 2"], first_seed=21)
    cell = next(c for c in table if c.quantity == "differential_retardance_fast_axis_deg")
    assert cell.all_95 > 0.9
    assert cell.in_95 > 0.95


def test_where_m00_is_noise_every_interval_is_everything() -> None:
    """Without light enough the ratio to m00 is no normal variate: 95 % intervals covered 43 %."""
    table = list(cells("24 others", 0, 20, 400, samples=["mirror", "retarder 2", "ideal depolarizer"], extra=EXTRA))
    for cell in table:
        if cell.quantity not in ("mueller", "dominant_mueller_jones"):
            assert cell.in_95 > 0.93, cell


def test_light_between_two_polarizers_may_be_twice_m00() -> None:
    """Where m00 is noise the intervals ended at 1, and covered 0 % of the pixels of a polarizer along both."""
    m = 2 * mueller.diattenuator(np.pi / 2, 1.0, 0.0)
    maps = quantities_block(noisy_image(np.tile(m, (PIXELS, 1, 1)), 2, 5), (), PAPER_PAIRS)
    for name, true in (("aligned_linear", 2.0), ("crossed_linear", 0.0), ("crossed_circular", 0.5)):
        low, high = maps[f"{name}_95"]
        assert np.mean((low <= true) & (true <= high)) > 0.93, name


@pytest.mark.parametrize("instrument", list(seven_instruments())[1:])
def test_poor_states_have_intervals_that_cover_too(instrument: str) -> None:
    table = list(
        cells(instrument, 0, 20_000, PIXELS, samples=["triply degenerate", "retarder 90", "mirror-like"], extra=())
    )
    low = [c for c in table if c.in_68 < LEAST_68 or c.in_95 < LEAST_95]
    assert len(low) <= 3, low


def test_the_noise_beside_the_largest_of_four_eigenvalues_is_less_than_that_of_three() -> None:
    """The largest of four takes a quarter of it: 68 % intervals of an ideal depolarizer covered 84 %."""
    table = cells("RGB950's 40", 1, 2000, 2000, samples=["ideal depolarizer"], extra=())
    found = [c for c in table if c.quantity == "td_missed"]
    assert len(found) == 1
    assert all(0.66 < c.in_68 < 0.75 and 0.935 < c.in_95 < 0.97 for c in found), found


def test_a_deviation_has_no_noise_of_the_mean_whatever_its_own() -> None:
    """The same was taken off a small error as off a large one: 95 % intervals covered 89 %."""
    found = cells("127 degrees, 9 to 1, 41", 1, 200, 1000, samples=["det < 0"], extra=(), first_seed=11)
    cell = next(c for c in found if c.quantity == "eigenvalue_deviation")
    assert 0.915 < cell.in_95 < 0.97


def test_a_ratio_to_a_noisy_m00_has_no_wider_error_than_its_noise() -> None:
    """It was the larger side of an uneven interval: 68 % intervals covered 74 % on average, 80 % at most."""
    samples = ["air", "mirror", "DoLP 0.2", "triply degenerate", "retarder 2", "polarizer 1:100"]
    found = list(cells("24 others", 4, 2000, 1000, samples=samples, extra=(), first_seed=3))
    for name in ("crossed_linear", "crossed_circular", "diattenuation_circular"):
        assert 0.66 < np.mean([c.in_68 for c in found if c.quantity == name]) < 0.715, name
