"""One judge for instrument and surface: verdict, what is applied, and how likely a correction makes M worse."""

from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.instrument.mueller_error import chance_later, chances, lasts
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.decision import Judgement, PredictedChange, predicted_change
from processing.diagnosis.search.fit import Fit, HeldOut, Solution
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.space import Space, Sums
from processing.diagnosis.surface import quantities
from processing.effect import Parameter
from processing.instrument.effects.psg_retardance import PsgRetardance

GROWS = (Check(name="rms", before=1.0, after=2.0, holds=False),)
FALLS = (Check(name="rms", before=2.0, after=1.0, holds=True),)


@pytest.mark.parametrize(
    ("named", "sure", "structure", "visible", "verdict"),
    [
        (False, False, False, True, "consistent"),
        (False, False, False, False, "undetermined"),
        (False, False, True, True, "unexplained"),
        (True, False, True, True, "unexplained"),
        (True, True, True, True, "partly_explained"),
        (True, False, False, True, "partly_explained"),
        (True, True, False, False, "explained"),
    ],
)
def test_verdict_of_names_and_what_is_left(named, sure, structure, visible, verdict) -> None:
    assert Judgement(named, sure, structure, visible, FALLS).verdict == verdict


def test_what_makes_the_residual_worse_explains_nothing() -> None:
    assert Judgement(True, True, False, True, GROWS).verdict == "unexplained"
    assert Judgement(False, False, False, True, GROWS).verdict == "consistent"


def test_a_chance_that_the_reading_gets_worse_refuses_the_correction_not_the_name() -> None:
    judged = Judgement(True, True, False, True, FALLS, chances=GROWS)
    assert judged.verdict == "explained"
    assert judged.refused == "rms, from 1 to 2"


def test_wiring_comes_first() -> None:
    judged = Judgement(True, True, False, True, FALLS, first="swap the axes")
    assert (judged.verdict, judged.refused) == ("unexplained", "change this first: swap the axes")


def test_where_no_pixel_shows_xi0_nothing_is_said_of_it(monkeypatch) -> None:
    """The mean over no pixel is no number, and by that every correction of a dim object was refused."""
    candidate = Candidate(PsgRetardance(), "", (Parameter("x", "1", -1.0, 1.0, 1.0),))
    fit = Fit(np.ones(1), Sums.empty(1, 1), 0.0)
    solved = Solution(Space(()), fit, None, Space((candidate,)), fit, None)
    problem = SimpleNamespace(captures=[None])
    monkeypatch.setattr(quantities, "_all_xi0", lambda *of: np.full(5, np.nan))
    assert quantities.chances(problem, solved, np.eye(1)) == ()
    monkeypatch.setattr(quantities, "_all_xi0", lambda problem, space, values: np.append(0.1 * values, np.nan))
    change = quantities.change_of_xi0(problem, solved, 0.01 * np.eye(1))
    assert (change.size, change.stderr) == pytest.approx((0.1, 0.0071), abs=1e-4)


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


def test_what_this_sample_shows_of_a_correction_is_not_what_another_one_does() -> None:
    """One of two values is known, and this sample shows that one alone; a third sample shows nothing."""
    mean, covariance = np.array([1.0, 0.1]), np.diag([1e-4, 1.0])
    shown = (np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.zeros((2, 2)))
    here, there, nowhere = (predicted_change(mean, mean, covariance, products) for products in shown)
    assert here.chance_worse < 1e-6
    assert there.chance_worse == pytest.approx(0.48, abs=0.01)
    assert chance_later((here, there, nowhere)) == pytest.approx(0.24, abs=0.01)
    assert chance_later((nowhere,)) == 0


def _solved(before: list[float], after: list[float]) -> Solution:
    """A correction that leaves so much excess of each capture."""
    held = [HeldOut(sum(x), 1.0, 1.0, 1.0, np.array([[1.0, 1.0, e, 1.0] for e in x])) for x in (before, after)]
    space, fit = Space(()), Fit(np.zeros(0), Sums.empty(1, 0, len(before)), 0.0)
    return Solution(space, fit, held[0], space, fit, held[1])


def test_of_captures_whose_sample_changed_the_others_bear_a_correction_out() -> None:
    assert lasts((NOTHING,), _solved([100.0], [0.0]))
    assert not lasts((NOTHING,), _solved([100.0], [0.0]), {0})
    assert lasts((NOTHING,), _solved([100.0, 50.0], [0.0, 0.0]), {0})
    assert not lasts((NOTHING,), _solved([100.0, 50.0], [0.0, 55.0]), {0})
    assert not lasts((NOTHING,), _solved([100.0, 50.0], [0.0, 0.0]), {0, 1})
    names = [check.name for check in chances(NOTHING, (NOTHING,), lasting=False, each={})]
    assert names[-1].endswith("so it is written for these captures alone")


def test_what_a_correction_does_to_each_of_several_captures_is_told_and_does_not_decide() -> None:
    flat = predicted_change(np.array([1e-3]), np.array([1e-3]), np.array([[1e-6]]), np.eye(1))
    *_, air, flat_check = chances(
        NOTHING, (NOTHING,), lasting=True, each={"air (air.h5)": NOTHING, "flat (flat.h5)": flat}
    )
    assert air.name == "predicted error of M/m00 of air (air.h5), rms (it grows with a chance of less than 0.0001)"
    assert flat_check.name == "predicted error of M/m00 of flat (flat.h5), rms (it grows with a chance of 0.31)"
    assert (flat_check.before, flat_check.after) == (flat.before, flat.after)
    assert flat_check.holds
