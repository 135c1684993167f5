"""Constants by which structure is seen, causes are named, and names are doubted."""

from dataclasses import replace
from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, cause, decides, made, one

from processing.diagnosis.instrument import combinations, doubts, outcome, source_patterns, telling
from processing.diagnosis.search import causes
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import ImageShift, SourceEffect, ValuePerState


@decides
def test_limit(m: Patch) -> bool:
    seen = [outcome.has_structure(Some(noise_known=True), [Some(tests={"a": t})]) for t in (4.8, 5.2)]
    return seen == [False, True]


@decides
def test_limit_of_two(m: Patch) -> bool:
    """Two tests together are beyond chance where one of them is not."""
    seen = [outcome.has_structure(Some(noise_known=True), [Some(tests={"a": 4.0, "b": t})]) for t in (3.4, 3.6)]
    return seen == [False, True]


def test_what_no_test_takes_for_structure_is_not_left():
    known, found = Some(noise_known=True), Some(tests={"a": 3.0, "b": -1.0}, left=50.0)
    assert outcome.left_of(known, found) == 0.0
    assert outcome.left_of(known, Some(tests={"a": 3.0, "b": 7.0}, left=50.0)) == 50.0


@decides
def test_white(m: Patch) -> bool:
    turns = [outcome.white(Some(mean=np.cos(2 * np.pi * t * np.arange(100) / 100))) for t in (19, 18)]
    return turns == [True, False]


@decides
def test_sure(m: Patch) -> bool:
    return [cause(probability=p).answer for p in (0.985, 0.995)] == ["likely", "sure"]


@decides
def test_likely(m: Patch) -> bool:
    return [cause(probability=p).answer for p in (0.89, 0.91)] == ["unknown", "likely"]


@decides
def test_alternative(m: Patch) -> bool:
    return causes.least_odds(20.0, 0.0) == 13.0


@decides
def test_alike(m: Patch) -> bool:
    return causes.least_odds(1e5, 0.0) == 1e5 - 100


@decides
def test_doubted(m: Patch) -> bool:
    return telling.told_answer(cause(), doubts.PART_OF_LEFT) == ("likely", 0.95)


def tied(correlation: float, ratio: float) -> bool:
    """Whether two values of so much correlation are told together, if their errors along and across have a ratio."""
    covariance = np.array([[1.0, correlation], [correlation, 1.0]])
    if ratio:
        size, vector = np.linalg.eigh(covariance)
        covariance = (vector * [size[1] / ratio**2, size[1]]) @ vector.T
    return bool(list(combinations.ties(np.ones(2), covariance, np.ones(2))))


@decides
def test_together(m: Patch) -> bool:
    m.setattr(combinations, "OPEN", 1.0)
    return not tied(0.89, 0.0) and tied(0.91, 0.0)


@decides
def test_open(m: Patch) -> bool:
    m.setattr(combinations, "TOGETHER", 0.5)
    return not tied(0.9, 4.8) and tied(0.9, 5.2)


@decides
def test_bound(m: Patch) -> bool:
    return [doubts._at_bound(cause(values=[v])) for v in (0.0009, 0.0011)] == [True, False]


def follows(m: Patch, *seen: tuple[float, float], sample: str | None = "air") -> bool:
    """Whether values follow a pattern that has, in each capture of such a sample, so much of so much."""
    told = replace(
        cause(), candidates=tuple(made() for _ in seen), values=(0,) * len(seen), covariance=(0,) * len(seen)
    )
    found = Some(space=Space(told.candidates), sets=one(1.0, 0.0, len(seen)), samples=Some(best=Some(unit=1.0)))
    each = iter(seen)
    m.setattr(doubts, "patterned", lambda *a: source_patterns.Patterned(*next(each), 10.0, 24.0, 40))
    return doubts._one_pattern(Some(captures=[Some(sample=sample, wavelength_nm=662.0)]), found, told)


@decides
def test_one_pattern(m: Patch) -> bool:
    return [follows(m, (held, 100.0)) for held in (83.0, 87.0)] == [False, True]


@decides
def test_chance_of_pattern(m: Patch) -> bool:
    return [follows(m, (held, 100.0), sample=None) for held in (52.5, 53.3)] == [False, True]


def test_a_capture_that_tells_little_does_not_make_all_others_follow_a_pattern(monkeypatch):
    assert not follows(monkeypatch, (900.0, 3000.0), (95.0, 100.0))
    assert follows(monkeypatch, (2900.0, 3000.0), (30.0, 100.0))


def test_of_what_is_hardly_beyond_noise_no_pattern_is_told(monkeypatch):
    assert not follows(monkeypatch, (9.0, 9.5))


def uneven(m: Patch, excess: float, odds: float) -> bool:
    told = cause(odds)
    even = Some(varies=lambda candidate: (excess, 2))
    return doubts._uneven(even, Some(space=Space(told.candidates), effects=()), told.candidates[0], told)


@decides
def test_edges(m: Patch) -> bool:
    told = cause(candidate=made(ImageShift))
    solved = Some(space=Space(told.candidates), fit=Some(values=None))

    def stands(share: float, explained: float) -> bool:
        seen = Some(share=np.array([share]), error=np.array([0.01]), explained=explained)
        m.setattr(doubts, "at_edges", lambda *of: seen)
        return doubts._standing(Some(noise_known=True), solved, [told]) == [told]

    return stands(0.37, 1.0) and stands(1.0, 0.41) and not stands(0.39, 0.45)


@decides
def test_uneven(m: Patch) -> bool:
    return not uneven(m, 11.5, 0.0) and uneven(m, 12.5, 0.0)


@decides
def test_uneven_share(m: Patch) -> bool:
    return not uneven(m, 1900.0, 1e5) and uneven(m, 2100.0, 1e5)


@decides
def test_testable(m: Patch) -> bool:
    problem = Some(powers=lambda: [(100, np.ones(1))], noise_known=False, wavelengths_nm=(662.0,))
    solved = Some(before=Some(excess=0.0))
    told = [cause(candidate=made(ValuePerState, size)) for size in (73, 77)]
    return [doubts.testable(problem, solved, c, [c]) for c in told] == [True, False]


def per_state(odds: float, *sizes: float) -> Cause:
    """A value of each of 40 states, in captures one after the other, of such sizes in units of their errors."""
    told = cause(odds, candidate=made(ValuePerState, 40))
    return replace(
        told,
        candidates=tuple(replace(told.candidates[0], capture=k) for k in range(len(sizes))),
        values=tuple(np.full(40, size) for size in sizes),
        covariance=told.covariance * len(sizes),
    )


def test_values_for_each_state_beside_others_that_hardly_take_part_are_testable():
    problem = Some(powers=lambda: [(100, np.ones(1))], noise_known=False, wavelengths_nm=(662.0,))
    solved = Some(before=Some(excess=0.0))
    strong, weak = (per_state(odds, 9.0) for odds in (2000.0, 2.0))
    assert doubts.testable(problem, solved, strong, [strong, weak])
    assert not doubts.testable(problem, solved, weak, [strong, weak])


def test_one_capture_that_tells_more_than_a_value_for_each_state_tests_them():
    problem = Some(powers=lambda: [(30, np.ones(1)), (60, np.ones(1))], noise_known=False, wavelengths_nm=(662.0,) * 2)
    solved = Some(before=Some(excess=0.0))
    found = [per_state(2000.0, *sizes) for sizes in ((9.0, 9.0), (9.0, 0.1))]
    assert [doubts.testable(problem, solved, c, [c]) for c in found] == [True, False]


def test_captures_that_tell_more_together_test_values_for_each_state():
    problem = Some(powers=lambda: [(39, np.ones(1)), (72, np.ones(1))], noise_known=False, wavelengths_nm=(662.0,) * 2)
    found = per_state(2000.0, 9.0, 0.1)
    assert doubts.testable(problem, Some(before=Some(excess=0.0)), found, [found])


def test_values_that_captures_share_count_once():
    problem = Some(powers=lambda: [(36, np.ones(1))] * 3, noise_known=False, wavelengths_nm=(500.0, 600.0, 700.0))
    shared = cause(2000.0, candidate=made(ValuePerState, 40))
    shared = replace(shared, values=(np.full(40, 9.0),))
    assert shared.candidates[0].capture is None
    assert doubts.testable(problem, Some(before=Some(excess=0.0)), shared, [shared])


def doubted(m: Patch, odds: float, known: bool, left: float) -> bool:
    m.setattr(doubts.Nameless, "beside", lambda *of: None)
    found = Some(samples=Some(best=Some(unit=1.0)), sets=Some(noise=Some(directions=1.0)), members=())
    told = cause(odds)
    solved = Some(space=Space(()), fit=Some(values=None))
    return told in doubts.doubts(Some(noise_known=known, captures=()), found, solved, [told], left)


@decides
def test_times(m: Patch) -> bool:
    return doubted(m, 48.0, True, 1.0) and not doubted(m, 52.0, True, 1.0)


@decides
def test_one_wave(m: Patch) -> bool:
    # A wave of the source explains as much as is said, the cause and what turns 50.
    turning = Some(axis="psg", ratio=1.0)
    problem = Some(
        captures=[Some(conditions=Some(angles_deg={"psg": np.zeros(1)}))], model=Some(elements=lambda: [turning])
    )

    def beats(explained: float) -> bool:
        m.setattr(source_patterns, "_best", lambda *of: np.full((1, 2), 7.0))
        m.setattr(source_patterns, "_held", lambda wave, curvature, gradient: explained if 7.0 in wave else 50.0)
        m.setattr(source_patterns, "_explained", lambda *of: 50.0)
        source = made(type("Source", (SourceEffect, ValuePerState), {}))
        told = cause()
        sets = Some(without=lambda *of: None, given_others=lambda *of: {0: (0, 0), 1: (np.eye(1), np.zeros(1))})
        found = Some(
            samples=Some(best=Some(tau=np.zeros(2))),
            sets=sets,
            members=((0,), (1,)),
            label=lambda g: [told.candidates[0], source][g],
            space=Some(candidates=(told.candidates[0], source)),
        )
        return source_patterns.beat_explains_as_well(problem, found, told)

    return not beats(58.5) and beats(59.5)


def test_what_is_one_of_several_is_not_asked_whether_a_source_beats(monkeypatch):
    """A weak one would take all stronger names with it, for what it explains would count as left."""
    monkeypatch.setattr(doubts, "beat_explains_as_well", lambda *of: True)
    told, problem = cause(), Some(noise_known=True, captures=())
    solved = Some(space=Space(()))
    either = replace(told, alternatives=(made(kind="another"),))
    reasons = [doubts._of_itself(problem, None, solved, c, [c], None) for c in (told, either)]
    assert reasons == [doubts.BEAT, None]


@decides
def test_unknown_noise(m: Patch) -> bool:
    return doubted(m, 24.0, False, 0.0) and not doubted(m, 26.0, False, 0.0)
