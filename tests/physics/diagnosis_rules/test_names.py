"""Constants by which structure is seen, causes are named, and names are doubted."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, cause, decides, made, one

from processing.diagnosis.instrument import combinations, doubts, judge, telling
from processing.diagnosis.search import causes
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import ValuePerState


@decides
def test_limit(m: Patch) -> bool:
    seen = [judge._structure(Some(noise_known=True), [Some(tests={"a": t})]) for t in (4.8, 5.2)]
    return seen == [False, True]


@decides
def test_white(m: Patch) -> bool:
    turns = [judge._white(Some(mean=np.cos(2 * np.pi * t * np.arange(100) / 100))) for t in (19, 18)]
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


@decides
def test_one_pattern(m: Patch) -> bool:
    told = cause()
    found = Some(space=Space(told.candidates), sets=one(1.0, 0.0), samples=Some(best=Some(unit=1.0)))
    said = []
    for share in (0.83, 0.87):
        m.setattr(doubts, "patterned_share", lambda values, information, s=share: s)
        said.append(doubts._one_pattern(found, told))
    return said == [False, True]


def uneven(m: Patch, excess: float, odds: float) -> bool:
    told = cause(odds)
    m.setattr(doubts, "unevenness", lambda *a: (excess, 2))
    solved = Some(space=Space(told.candidates), effects=(), fit=Some(values=None))
    return doubts._uneven(None, solved, told.candidates[0], told)


@decides
def test_uneven(m: Patch) -> bool:
    return not uneven(m, 11.5, 0.0) and uneven(m, 12.5, 0.0)


@decides
def test_uneven_share(m: Patch) -> bool:
    return not uneven(m, 1900.0, 1e5) and uneven(m, 2100.0, 1e5)


@decides
def test_testable(m: Patch) -> bool:
    problem = Some(powers=lambda: [(100, np.ones(1))], noise_known=False)
    solved = Some(before=Some(excess=0.0))
    told = [cause(candidate=made(ValuePerState, size)) for size in (73, 77)]
    return [doubts.testable(problem, solved, c, [c]) for c in told] == [True, False]


def doubted(odds: float, known: bool, left: float) -> bool:
    found = Some(samples=Some(best=Some(unit=1.0)), sets=Some(noise=Some(directions=1.0)))
    told = cause(odds)
    return told in doubts.doubts(Some(noise_known=known), found, None, [told], left)


@decides
def test_times(m: Patch) -> bool:
    return doubted(48.0, True, 1.0) and not doubted(52.0, True, 1.0)


@decides
def test_unknown_noise(m: Patch) -> bool:
    return doubted(24.0, False, 0.0) and not doubted(26.0, False, 0.0)
