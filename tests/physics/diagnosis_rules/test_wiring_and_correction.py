"""Constants by which a mistake of wiring, and a correction, are told."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, cause, decides, made

from processing.diagnosis.instrument import cautious, empirical, guard, whole_bench, wiring
from processing.diagnosis.instrument.doubts import PART_OF_LEFT, WAVE, WAVE_AS_WELL, something_else
from processing.diagnosis.instrument.names import Names, unfit
from processing.diagnosis.search import causes
from processing.diagnosis.search.guard import PredictedChange, held_out_check, refusal, rows_checks
from processing.diagnosis.search.result import Empirical
from processing.diagnosis.search.sets import Quadratic
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import FieldEffect, GeneralEffect


def miswired(m: Patch, start: float, without: float) -> bool:
    m.setattr(wiring, "_other_wavelengths", lambda *a: [])
    m.setattr(wiring, "_mistakes", lambda problem: iter([Some(problem="mended")]))
    m.setattr(wiring, "_left", lambda problem, *at: without if problem == "mended" else start)
    return wiring.miswired(Some(nominal=lambda: ())) is not None


@decides
def test_wiring(m: Patch) -> bool:
    return miswired(m, 1000.0, 190.0) and not miswired(m, 1000.0, 210.0)


@decides
def test_decisive(m: Patch) -> bool:
    return miswired(m, 28.0, 0.5) and not miswired(m, 23.0, 0.5)


def takes_part(m: Patch, probabilities: list[float], told: causes.Cause | None = None, mean: float = 0.0) -> list[str]:
    """Places that take part in a correction; each of them takes its mean squared of chi-square away."""
    space = Space(tuple(made(place=str(k)) for k in range(len(probabilities))))
    found = Some(
        space=space,
        members=[(k,) for k in range(len(probabilities))],
        label=lambda g: space.candidates[g],
        samples=Some(probability=np.array(probabilities), best=Some(unit=1.0)),
        sets=Some(form=Quadratic(0.0, np.full(space.size, -mean), np.eye(space.size))),
        values=np.full(space.size, mean),
    )
    names = ()
    if told is not None:
        names = (Some(probability=1.0, candidates=space.candidates[:1], alternatives=space.candidates[1:]),)
    m.setattr(whole_bench, "causes", lambda found, left: names)
    return [c.place for c in whole_bench.applied(found, Space(()))[0].candidates]


@decides
def test_takes_part(m: Patch) -> bool:
    return takes_part(m, [0.23, 0.27]) == ["1"]


@decides
def test_missed(m: Patch) -> bool:
    # Without the second one 3.9 is left, without both twice as much; or 2.05 of each of three.
    two = takes_part(m, [0.2, 0.1], mean=np.sqrt(3.9))
    return two == ["0"] and takes_part(m, [0.2, 0.1, 0.05], mean=np.sqrt(2.05)) == ["0", "1"]


@decides
def test_shares(m: Patch) -> bool:
    return takes_part(m, [0.5, 0.009, 0.011], cause()) == ["0", "2"]


def guarded(rms: float, condition: float) -> bool:
    solved = Some(before=Some(rms=1.0), after=Some(rms=rms))
    figures = (
        held_out_check(solved),
        *rows_checks("a", np.eye(2), np.diag([1, 1 / condition])),
    )
    return refusal(figures) is None


@decides
def test_worse(m: Patch) -> bool:
    return guarded(1.0019, 1.0) and not guarded(1.0021, 1.0)


def determined(size: float) -> bool:
    change = PredictedChange(before=0.005, after=0.001, size=size, expected=size, stderr=0.001)
    return refusal(guard.chances(change, change, lasting=True, each={})) is None


@decides
def test_chance_worse(m: Patch) -> bool:
    return determined(0.00472) and not determined(0.00458)


@decides
def test_least_change(m: Patch) -> bool:
    small = [PredictedChange(1e-4, 1e-4, size=size, expected=size, stderr=1e-4) for size in (1.9e-5, 2.1e-5)]
    return [change.chance_worse > 0.4 for change in small] == [False, True]


@decides
def test_as_good_as(m: Patch) -> bool:
    # M follows one value alone, which is so many standard deviations from zero.
    there = [cautious.less_far(np.array([d]), np.eye(1), np.eye(1), 1e6) is not None for d in (0.95, 1.05)]
    return there == [True, False]


@decides
def test_worse_condition(m: Patch) -> bool:
    return guarded(1.0, 1.4) and not guarded(1.0, 1.6)


def without_name(m: Patch, *left: float) -> Empirical | None:
    """The empirical correction where nothing leaves 100 and each of some effects leaves so much."""
    candidates = [made(GeneralEffect, kind=f"k{k}") for k in range(len(left))]
    rest = iter((100.0, *left))
    m.setattr(empirical, "_left", lambda found, index: (next(rest), np.zeros(index.size)))
    found = Some(space=Space(tuple(candidates)), sets=Some(noise=Some(slack=0.0, known=True)))
    solved = Some(space=Space(()), before=Some(excess=100.0, freedom=100.0, rms=0.01))
    return empirical.empirical(found, solved)


@decides
def test_empirical_share(m: Patch) -> bool:
    return without_name(m, 91.0) is None and without_name(m, 89.0) is not None


@decides
def test_also(m: Patch) -> bool:
    told = without_name(m, 0.0, 2.7, 3.3)
    return told is not None and told.would_also_fit == ("k0", "k1")


def test_beside_what_is_in_no_list_only_what_has_a_name_of_its_own_is_used() -> None:
    waved, named, likely, nameless = (made(kind=kind) for kind in ("waved", "named", "likely", "nameless"))
    field = made(FieldEffect)
    told = tuple(cause(odds=50.0, candidate=c) for c in (waved, named, likely))
    problem = Some(captures=[Some(sample=None, wavelength_nm=662.0)])
    solved = Some(effects=(waved, named, likely, nameless, field))
    doubt = {told[0]: WAVE, told[2]: PART_OF_LEFT}
    assert unfit(problem, solved, Names(told, (), doubt)) == [waved, likely, nameless]
    assert unfit(problem, solved, Names(told, (), {told[2]: PART_OF_LEFT})) == []
    # Where the wave only does as well, what stands beside both stays; as many values as the data have may be anything.
    assert unfit(problem, solved, Names(told, (), {told[0]: WAVE_AS_WELL, told[2]: PART_OF_LEFT})) == [waved]
    assert unfit(problem, solved, Names(told[1:], told[:1], {told[2]: PART_OF_LEFT})) == [waved, likely, nameless]
    # What hardly explains anything is left out by itself alone: a bench of .0124 was corrected to .0088, and .0003 now.
    weak = cause(odds=10.0, candidate=waved)
    assert unfit(problem, solved, Names((weak, *told[1:]), (), {weak: WAVE, told[2]: PART_OF_LEFT})) == [waved]
    # A sample that is known takes up nothing.
    problem.captures[0].sample = "air"
    assert unfit(problem, solved, Names(told, (), doubt)) == []


def test_what_hardly_stands_out_takes_no_stronger_name_with_it() -> None:
    """A cause of 8 in chi-square that was something else had the names of nine others, of up to 1300, doubted."""
    weak, strong = cause(odds=4.0), cause(odds=10.0)
    assert something_else({weak: WAVE, strong: WAVE}) == [strong]
    assert something_else({weak: WAVE, strong: PART_OF_LEFT}) == []
