"""Constants of the search, and what it may cost."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace as Some

import numpy as np
import pytest
from rule_decisions import QUIET, Asked, Patch, bench, decides, made

from processing.diagnosis.instrument import outcome, starts, whole_bench
from processing.diagnosis.search import descent, down_to_noise, likely_set, posterior
from processing.diagnosis.search.sets import Group, Quadratic, Sets, State
from processing.diagnosis.search.space import Space, Sums


@decides
def test_far_off(m: Patch) -> bool:
    m.setattr(starts, "_far", lambda *a: "far")
    said = []
    for rms in (0.045, 0.055):
        m.setattr(starts, "minimize", lambda *a, r=rms: Some(values=np.zeros(0), rms=r))
        said.append(starts.first_values(None, Space(()), (), lambda line: None))
    return said == [{}, "far"]


def rounds(
    m: Patch, unit: float = 1.0, moves: float = 9.0, known: bool = True, told: bool = True
) -> tuple[list[int], bool]:
    """Sets visited in each round of `posterior` of a value that moves by so many deviations, and whether all began."""
    visits: list[int] = []
    all_first = False

    def visit(sets: Sets, state: State, count: int) -> Some:
        visits.append(count)
        return Some(mean=np.zeros(1), covariance=np.eye(1), probability=np.zeros(1))

    def everything(
        problem: object, space: object, fixed: object, x: np.ndarray, noise: object, tau: float
    ) -> np.ndarray:
        nonlocal all_first
        all_first = True
        return x

    m.setattr(posterior, "quadratic", lambda *a: Quadratic(0.0, np.zeros(1), np.eye(1)))
    m.setattr(posterior, "noise_of", lambda *a: replace(QUIET, known=known))
    m.setattr(posterior, "likely_set", lambda s: State(np.zeros(1), unit))
    m.setattr(descent, "sample", visit)
    m.setattr(posterior, "sample", visit)
    m.setattr(posterior, "stay", visit)
    m.setattr(posterior, "all_at_once", everything)
    m.setattr(descent, "improved", lambda *of: np.full(1, moves * len(visits)))
    m.setattr(posterior, "_posterior_of", lambda *a: None)
    m.setattr(posterior, "down_to_noise", lambda *a: None)
    problem = Some(noise_known=told, relinearize=lambda *a: False, sums=lambda *a: Sums.empty(1, 1))
    posterior.posterior(problem, Space((made(),)), (), np.zeros(1), lambda line: None)
    return visits, all_first


@decides
def test_near_enough(m: Patch) -> bool:
    tried = []
    for rms in (0.009, 0.011):
        fits = iter(Some(excess=-float(k), values=np.zeros(0), rms=rms if k else 1.0) for k in range(99))
        m.setattr(starts, "minimize", lambda *a, f=fits, **k: next(f))
        tried.append(starts.best_of_starts(None, Space(()), 5).excess)
    # The first good one, or the last of all.
    return tried == [-2.0, -7.0]


@decides
def test_bent(m: Patch) -> bool:
    return not rounds(m, unit=1.9)[1] and rounds(m, unit=2.1)[1]


def full(m: Patch, units: Sequence[float]) -> tuple[list[float], int]:
    """Widths from which a search in full begins, and how often it goes on while the unit is one of these."""
    widths: list[float] = []
    left, gone_on = iter(units), 0

    def go_on(*of: object) -> tuple[np.ndarray, bool]:
        nonlocal gone_on
        gone_on += 1
        return np.zeros(1), False

    m.setattr(down_to_noise, "all_at_once", lambda *of: widths.append(of[-1]))
    m.setattr(down_to_noise, "quadratic", lambda *of: Quadratic(0.0, np.zeros(1), np.eye(1)))
    m.setattr(down_to_noise, "noise_of", lambda *of: Some(unit=lambda excess: next(left, 99.0)))
    m.setattr(down_to_noise, "likely_set", lambda sets: None)
    m.setattr(down_to_noise, "next_values", go_on)
    problem = Some(relinearize=lambda *of: False, sums=lambda *of: Sums.empty(1, 1))
    down_to_noise.down_to_noise(problem, Space((made(),)), (), [Group(np.array([0]))], np.zeros(1), QUIET, 10.0)
    return widths, gone_on


@decides
def test_shrunk(m: Patch) -> bool:
    return full(m, [10.0])[0] == [0.3]


@decides
def test_gaining(m: Patch) -> bool:
    return full(m, [4.5, 9.0])[1] == 1 and full(m, [5.5])[1] == 0


@decides
def test_rounds(m: Patch) -> bool:
    return len(rounds(m)[0]) == 7


@decides
def test_settled(m: Patch) -> bool:
    return len(rounds(m, moves=0.27)[0]) == 2 and len(rounds(m, moves=0.33)[0]) > 2


@decides
def test_changes(m: Patch) -> bool:
    return rounds(m)[0][-1] == 1000


@decides
def test_samples(m: Patch) -> bool:
    return rounds(m, known=False)[0][-1] == 300


@decides
def test_samples_before(m: Patch) -> bool:
    return rounds(m)[0][0] == 80


@decides
def test_hope(m: Patch) -> bool:
    s = Asked([-5.5, -6.5])
    likely_set.climb(s, s.empty())
    return s.fits == 2


@decides
def test_patience(m: Patch) -> bool:
    s = Asked([1.0] * 30)
    likely_set.climb(s, s.empty())
    return s.fits == 1 + 9


@decides
def test_needed(m: Patch) -> bool:
    kept, tried = Asked([13.0]), Asked([11.0])
    likely_set.thinned(kept)
    likely_set.thinned(tried)
    return kept.conditionals == 1 < tried.conditionals


@decides
def test_growth(m: Patch) -> bool:
    return outcome.grown(np.array([1.06]), 1.0) and not outcome.grown(np.array([1.04]), 1.0)


@pytest.mark.parametrize(("unit", "kept"), [(330.0, 0), (1.02, 1)])
def test_noise_that_looks_like_structure_takes_nothing_away(monkeypatch: Patch, unit: float, kept: int) -> None:
    """Of many pixels a thousandth of the noise is structure, in the light of which seven causes became nothing."""
    found = [Some(samples=Some(best=Some(unit=u)), space=Space(())) for u in (1.0, unit)]
    each = iter(found)
    whole = Some(noise_known=True, holds_out_states=False)
    tried = bench(pool=(), whole=whole, problem=whole)
    monkeypatch.setattr(whole_bench, "applied", lambda *of: ())
    nothing = {"_clipped": [], "as_many_as_intensities": set(), "_take_noise_of_light": None, "_adopt_noise": True}
    for name, answer in nothing.items():
        monkeypatch.setattr(whole_bench.WholeBench, name, lambda self, *of, answer=answer: answer)
    monkeypatch.setattr(whole_bench.WholeBench, "_posterior", lambda self, *of: next(each))
    monkeypatch.setattr(whole_bench.WholeBench, "_with_what_scatters_so", lambda self, found, fixed: found)
    assert tried.run() is found[kept]
