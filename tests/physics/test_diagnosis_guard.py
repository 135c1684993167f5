"""The guard of a correction: how likely it is that it makes M worse."""

import numpy as np
import pytest

from processing.diagnosis.instrument.mueller_error import chances, lasts
from processing.diagnosis.search.decision import PredictedChange, predicted_change
from processing.diagnosis.search.fit import Fit, HeldOut, Solution
from processing.diagnosis.search.space import Space, Sums

NOTHING = PredictedChange(0.0, 0.0, 0.0, 0.0, 0.0)


def test_chance_that_m_gets_worse_is_that_of_draws_from_the_posterior() -> None:
    random = np.random.default_rng(0)
    for size, share in ((0.3, 1.0), (1.0, 1.0), (2.0, 1.0), (1.0, 0.6), (1.0, 1.3)):
        root, slopes = random.normal(size=(4, 4)), random.normal(size=(60, 4)) / 60
        mean = size * random.normal(size=4)
        change = predicted_change(share * mean, mean, root @ root.T, slopes.T @ slopes)
        truth = mean + random.normal(size=(40_000, 4)) @ root.T
        before = np.sum((truth @ slopes.T) ** 2, axis=1)
        after = np.sum(((truth - share * mean) @ slopes.T) ** 2, axis=1)
        assert change.chance_worse == pytest.approx(np.mean(after > before), abs=0.01)
        assert change.before**2 == pytest.approx(np.mean(before), rel=0.03)
        assert change.after**2 == pytest.approx(np.mean(after), rel=0.03)


def test_of_tied_values_the_sum_that_the_data_tell_counts() -> None:
    # Two azimuths of which the sum is known to 0.01 and the difference not at all, which M hardly notices.
    tied = 0.01**2 * np.ones((2, 2)) / 4 + 0.3**2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    moves_with_the_sum = np.ones((2, 2)) + 1e-6 * np.eye(2)
    mean = np.array([0.05, 0.05])
    assert predicted_change(mean, mean, tied, moves_with_the_sum).chance_worse < 1e-6
    assert predicted_change(mean, mean, tied, np.eye(2)).chance_worse < 1e-6
    assert predicted_change(mean, mean, tied, np.diag([1.0, 0.0])).chance_worse > 0.4


def test_an_alternative_stands_in_for_what_is_applied() -> None:
    # A slip, or in one case of ten another that moves M in the same way: wrong about the name, right about M.
    mean, covariance = np.array([0.9, 0.1]), 0.09 * np.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-4 * np.eye(2)
    values = np.array([0.9, 0.0])
    assert predicted_change(values, mean, covariance, np.ones((2, 2))).chance_worse < 1e-6
    assert predicted_change(values, mean, covariance, np.eye(2)).chance_worse > 0.05


def test_nothing_that_is_changed_makes_nothing_worse() -> None:
    assert predicted_change(np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))).chance_worse == 0
    assert predicted_change(np.array([1e-9]), np.array([1e-9]), np.eye(1), np.eye(1)).chance_worse == 0


def _solved(before: list[float], after: list[float]) -> Solution:
    """A correction that leaves so much excess of each capture."""
    held = [HeldOut(sum(x), 1.0, 1.0, 1.0, np.array([[1.0, 1.0, e, 1.0] for e in x])) for x in (before, after)]
    space, fit = Space(()), Fit(np.zeros(0), Sums.empty(1, 0, len(before)), 0.0)
    return Solution(space, fit, held[0], space, fit, held[1])


def test_of_captures_whose_sample_changed_the_others_bear_a_correction_out() -> None:
    assert lasts(NOTHING, _solved([100.0], [0.0]))
    assert not lasts(NOTHING, _solved([100.0], [0.0]), {0})
    assert lasts(NOTHING, _solved([100.0, 50.0], [0.0, 0.0]), {0})
    assert not lasts(NOTHING, _solved([100.0, 50.0], [0.0, 55.0]), {0})
    assert not lasts(NOTHING, _solved([100.0, 50.0], [0.0, 0.0]), {0, 1})
    names = [check.name for check in chances(NOTHING, NOTHING, lasting=False, each={})]
    assert names[-1].endswith("so it is written for these captures alone")


def test_what_a_correction_does_to_each_of_several_captures_is_told_and_does_not_decide() -> None:
    flat = predicted_change(np.array([1e-3]), np.array([1e-3]), np.array([[1e-6]]), np.eye(1))
    *_, air, flat_check = chances(
        NOTHING, NOTHING, lasting=True, each={"air (air.h5)": NOTHING, "flat (flat.h5)": flat}
    )
    assert air.name == "predicted error of M/m00 of air (air.h5), rms (it grows with a chance of less than 0.0001)"
    assert flat_check.name == "predicted error of M/m00 of flat (flat.h5), rms (it grows with a chance of 0.31)"
    assert (flat_check.before, flat_check.after) == (flat.before, flat.after)
    assert flat_check.holds
