"""The guard of a correction: how likely it is that it makes M worse."""

from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.instrument import in_part
from processing.diagnosis.instrument.cautious import less_far
from processing.diagnosis.instrument.doubts import OF_THE_SAMPLE, PART_OF_LEFT
from processing.diagnosis.instrument.guard import chances, lasts, predicted_change_of_part
from processing.diagnosis.search.guard import NOTHING, predicted_change


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


def test_where_no_cause_is_sure_what_is_left_counts_against_the_change() -> None:
    """A shadow that turns is described in part by a beam that wanders: of 725 of chi-square 125 are left."""
    told = predicted_change(np.array([1e-3]), np.array([1e-3]), np.array([[1e-10]]), np.eye(1))
    assert told.chance_worse < 1e-6
    assert told.beside(0.0, 600.0).chance_worse == pytest.approx(told.chance_worse)
    assert told.beside(6.0, 600.0).chance_worse < 1e-6
    assert told.beside(125.0, 600.0).chance_worse == pytest.approx(0.137, abs=0.005)
    assert told.beside(125.0, 0.0).chance_worse == pytest.approx(0.309, abs=0.005)


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
    mean, both = np.array([0.9, 0.1]), 0.09 * np.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-4 * np.eye(2)
    first, given = np.array([True, False]), np.array([0.9, 0.0])
    assert predicted_change_of_part(given, mean, both, np.ones((2, 2)), first).chance_worse < 1e-6
    assert predicted_change_of_part(given, mean, both, np.eye(2), first).chance_worse > 0.05
    # What is open beside it and moves with it makes it no worse.
    beside = 0.09 * np.ones((2, 2)) + np.diag([0.0, 1.0])
    mean = np.array([0.9, 0.0])
    alone = predicted_change_of_part(mean, mean, beside, np.diag([1.0, 0.0]), first)
    assert predicted_change_of_part(mean, mean, beside, np.ones((2, 2)), first).stderr == pytest.approx(alone.stderr)


def test_nothing_that_is_changed_makes_nothing_worse() -> None:
    assert predicted_change(np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))).chance_worse == 0
    assert predicted_change(np.array([1e-9]), np.array([1e-9]), np.eye(1), np.eye(1)).chance_worse == 0


def test_what_is_open_is_used_to_leave_m_as_it_is() -> None:
    # A sum that is known to 0.01; M follows the first value alone.
    known, open_ = np.ones((2, 2)) / 4, np.array([[1.0, -1.0], [-1.0, 1.0]])
    mean, products = np.array([0.05, 0.05]), np.diag([1.0, 0.0])
    moved = less_far(mean, 0.01**2 * known + 0.3**2 * open_, products, 1e6)
    assert moved is not None
    np.testing.assert_allclose(moved, [0.0, 0.1], atol=1e-3)
    assert less_far(mean, 0.01**2 * (known + open_), products, 1e6) is None


def test_beside_a_sample_that_changed_nothing_is_kept_for_later_captures() -> None:
    assert lasts(NOTHING, [PART_OF_LEFT])
    assert not lasts(NOTHING, [PART_OF_LEFT, OF_THE_SAMPLE])
    told = [check.name for check in chances(NOTHING, NOTHING, lasting=False, each={})]
    assert told[-1].endswith("so it is written for these captures alone")


def test_what_a_correction_does_to_each_of_several_captures_is_told_and_does_not_decide() -> None:
    flat = predicted_change(np.array([1e-3]), np.array([1e-3]), np.array([[1e-6]]), np.eye(1))
    *_, air, told = chances(NOTHING, NOTHING, lasting=True, each={"air (air.h5)": NOTHING, "flat (flat.h5)": flat})
    assert air.name == "predicted error of M/m00 of air (air.h5), rms (it grows with a chance of less than 0.0001)"
    assert told.name == "predicted error of M/m00 of flat (flat.h5), rms (it grows with a chance of 0.31)"
    assert (told.before, told.after) == (flat.before, flat.after)
    assert told.holds


@pytest.mark.parametrize(
    ("probability", "kept"),
    [
        ((1.0, 0.7, 0.4), ["a"]),
        # Without the least certain one it holds.
        ((1.0, 0.4, 0.7), ["a", "c"]),
        # Nothing is sure: the correction stays as it is, and is refused as a whole.
        ((0.9, 0.9, 0.9), ["a", "b", "c"]),
        # What may make M worse is itself sure.
        ((1.0, 1.0, 1.0), ["a", "b", "c"]),
    ],
)
def test_a_correction_is_applied_in_part(monkeypatch, probability, kept) -> None:
    """M may get worse by effect b: the least certain effects go first, what is sure stays with its own value."""
    covariance = np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    slices = [slice(k, k + 1) for k in range(3)]
    values = np.array([2.0, 1.0, 3.0])

    def solved(now, without):
        left = [k for k, name in enumerate("abc") if name not in without]
        space = SimpleNamespace(candidates=["abc"[k] for k in left], slices=[slice(n, n + 1) for n in range(len(left))])
        return SimpleNamespace(effects=space.candidates, space=space, fit=SimpleNamespace(values=now[left]))

    def outcome(now, without):
        found = SimpleNamespace(
            space=SimpleNamespace(candidates=list("abc"), slices=slices),
            samples=SimpleNamespace(probability=probability),
            members=[[0], [1], [2]],
            values=values,
            covariance=covariance,
        )
        return SimpleNamespace(asked=None, found=found, solved=solved(now, without), corrected_by=outcome)

    def changes(asked, found, solution):
        return (SimpleNamespace(chance_worse=0.3 if "b" in solution.effects else 0.0),)

    monkeypatch.setattr(in_part, "predicted_changes", changes)
    used = in_part.in_part(outcome(values, []))
    assert used.solved.effects == kept
    # As the covariance has them: a takes half of what b no longer explains.
    first = 2.0 if "b" in kept else 1.5
    assert used.solved.fit.values[0] == pytest.approx(first)
