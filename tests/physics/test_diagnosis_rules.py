"""Every constant of search/rules.py: a decision that is another one when the constant is changed by a fifth."""

from collections.abc import Callable
from types import SimpleNamespace as Some

import numpy as np
import pytest
import rules_page

from processing.diagnosis.instrument import (
    combinations,
    doubts,
    empirical,
    evidence,
    guard,
    judge,
    recommend,
    starts,
    systematic,
    telling,
    whole_bench,
    wiring,
)
from processing.diagnosis.search import causes, likely_set, own_minima, posterior, rules, sampling, sets
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.result import Empirical
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space, Sums
from processing.diagnosis.surface import data as surface_data
from processing.diagnosis.surface import judge as surface_judge
from processing.diagnosis.surface import naming as surface_naming
from processing.diagnosis.surface import recommend as surface_recommend
from processing.effect import Parameter
from processing.instrument.effects.base import GeneralEffect, ImageShift, ValuePerState

MODULES = (
    *(
        combinations,
        doubts,
        evidence,
        empirical,
        guard,
        judge,
        recommend,
        starts,
        systematic,
        telling,
        whole_bench,
        wiring,
    ),
    *(causes, likely_set, own_minima, posterior, rules, sampling, sets),
    *(surface_data, surface_judge, surface_naming, surface_recommend),
)
NAMES = [name for name in vars(rules) if name.isupper()]
QUIET = Noise(known=True, directions=30.0, slack=1e9)
Patch = pytest.MonkeyPatch
#: What has to hold as the rules are, by name of the constant that decides.
DECIDED: dict[str, Callable[[Patch], bool]] = {}


def decides(name: str) -> Callable[[Callable[[Patch], bool]], Callable[[Patch], bool]]:
    def keep(decision: Callable[[Patch], bool]) -> Callable[[Patch], bool]:
        DECIDED[name] = decision
        return decision

    return keep


def made(family: type = object, size: int = 1, kind: str = "it", place: str = "") -> Candidate:
    """A candidate of a family of effects, with parameters from 0 to 1 of typical size 1."""

    nothing = dict.fromkeys(("places", "parameters", "apply", "axis", "first_state"))
    effect = type("Made", (family,), {**nothing, "kind": kind, "describes": "a gain for each state"})()
    return Candidate(effect, place, tuple(Parameter("p", "1", 0.0, 1.0, 1.0) for _ in range(size)))


def cause(odds: float = 0.0, probability: float = 1.0, candidate: Candidate | None = None, values=None) -> causes.Cause:
    candidate = candidate or made()
    values = np.full(candidate.size, 0.5) if values is None else np.array(values)
    return causes.Cause((candidate,), (values,), (np.eye(candidate.size),), probability, odds, ())


def one(curvature: float, gradient: float, groups: int = 1, noise: Noise = QUIET) -> Sets:
    form = Quadratic(0.0, np.full(groups, gradient), np.eye(groups) * curvature)
    return Sets(form, [Group(np.array([k])) for k in range(groups)], noise)


def bench(**known: object) -> whole_bench.WholeBench:
    out = object.__new__(whole_bench.WholeBench)
    vars(out).update({"base": Space(()), "say": lambda line: None} | known)
    return out


def own(**known: object) -> own_minima.OwnMinima:
    out = object.__new__(own_minima.OwnMinima)
    vars(out).update(known)
    return out


# ---- prior ---------------------------------------------------------------------------------------------------------
@decides("TAU")
def _(m: Patch) -> bool:
    s, state = one(1.0, -5.0), State(np.ones(1))
    likely_set.retune(s, state)
    return abs(s.fitted(state).mean[0] - 4.5) < 0.05


@decides("TAU_WEIGHT")
def _(m: Patch) -> bool:
    return abs(one(0.0, 0.0).conditional(State(np.zeros(1))).log_odds[0] - np.log(1 / 0.5)) < 0.05


@decides("FEW_CAUSES")
def _(m: Patch) -> bool:
    return abs(one(0.0, 0.0, groups=10).conditional(State(np.zeros(10))).log_odds[0] + np.log(14)) < 0.02


@decides("NOMINAL_TAU")
def _(m: Patch) -> bool:
    candidate = made()
    (group,) = posterior.grouped(Space((candidate,)), [candidate])[1]
    s = Sets(Quadratic(0.0, np.array([-1.0, 0.0]), 0.01 * np.eye(2)), [group, Group(np.array([1]))], QUIET)
    return abs(s.fitted(s.empty()).mean[0] - 50) < 5


@decides("UNSEEN")
def _(m: Patch) -> bool:
    found = Some(space=Space((made(),)), sets=one(0.0, 0.0), samples=Some(best=State(np.zeros(1)), probability=[0.0]))
    return abs(systematic._unseen(found)[0, 0] - 0.3) < 0.01


# ---- noise ---------------------------------------------------------------------------------------------------------
def noise(known: bool, excess: float, freedom: float) -> Noise:
    sums = Sums.empty(1, 0)
    sums.excess[0], sums.freedom[0], sums.square[0], sums.count[0] = excess, freedom, 1.0, 1.0
    return posterior.noise_of(Some(noise_known=known, spread=1.0, powers=lambda: [(10, np.ones(1))]), sums)


@decides("SLACK")
def _(m: Patch) -> bool:
    n = noise(True, 0.0, 50.0)
    return n.unit(18.0) == 1.0 < n.unit(22.0)


@decides("LEAST_NOISE")
def _(m: Patch) -> bool:
    return abs(noise(False, 0.0, 100.0).unit(0.0) - 1e-8) < 1e-9


@decides("REFUTED")
def _(m: Patch) -> bool:
    candidates = [made(place="a"), made(place="b")]
    odds = {candidates[0]: -11.0, candidates[1]: -13.0}
    m.setattr(whole_bench, "applied", lambda found, base: (Space(()), np.zeros(0)))
    m.setattr(whole_bench, "exactly_undone", lambda *a, **k: {c: np.ones(1) for c in candidates})
    m.setattr(whole_bench, "scatter_prefers", lambda problem, space, values, new, old: odds[next(iter(new))])
    asked = bench(whole=Some(noise_known=True, captures=[]))
    m.setattr(asked, "_posterior", lambda rest, fixed, found: Some(score=0.0, rest=rest))
    found = Some(score=0.0, space=Some(candidates=candidates), rest=candidates)
    return asked._with_what_scatters_so(found, []).rest == candidates[:1]


# ---- search --------------------------------------------------------------------------------------------------------
@decides("FAR_OFF")
def _(m: Patch) -> bool:
    m.setattr(starts, "minimize", lambda *a: Some(values=np.zeros(0)))
    m.setattr(starts, "_far", lambda *a: "far")
    said = []
    for rms in (0.045, 0.055):
        m.setattr(starts, "rms", lambda fit, r=rms: r)
        said.append(starts.first_values(None, Space(()), (), lambda line: None))
    return said == [{}, "far"]


def rounds(m: Patch, unit: float = 1.0, moves: float = 9.0) -> tuple[list[int], bool]:
    """Sets visited in each round of `posterior` of a value that moves by so many deviations, and whether all began."""
    visits: list[int] = []
    all_first = False

    def visit(sets: Sets, state: State, count: int) -> Some:
        visits.append(count)
        return Some(mean=np.zeros(1), covariance=np.eye(1), probability=np.zeros(1))

    def everything(problem: object, space: object, fixed: object, x: np.ndarray, noise: object) -> np.ndarray:
        nonlocal all_first
        all_first = True
        return x

    m.setattr(posterior, "quadratic", lambda *a: Quadratic(0.0, np.zeros(1), np.eye(1)))
    m.setattr(posterior, "noise_of", lambda *a: QUIET)
    m.setattr(posterior, "likely_set", lambda s: State(np.zeros(1), unit))
    m.setattr(posterior, "sample", visit)
    m.setattr(posterior, "_everything", everything)
    m.setattr(posterior, "_improved", lambda problem, space, groups, samples, x: np.full(1, moves * len(visits)))
    m.setattr(posterior, "_posterior_of", lambda *a: None)
    problem = Some(noise_known=True, relinearize=lambda *a: False, sums=lambda *a: Sums.empty(1, 1))
    posterior.posterior(problem, Space((made(),)), (), np.zeros(1), lambda line: None)
    return visits, all_first


@decides("NEAR_ENOUGH")
def _(m: Patch) -> bool:
    m.setattr(starts, "rms", lambda fit: fit.rms)
    tried = []
    for rms in (0.009, 0.011):
        fits = iter(Some(excess=-float(k), values=np.zeros(0), rms=rms if k else 1.0) for k in range(99))
        m.setattr(starts, "minimize", lambda *a, f=fits, **k: next(f))
        tried.append(starts.best_of_starts(None, Space(()), 5).excess)
    # The first good one, or the last of all.
    return tried == [-2.0, -7.0]


@decides("BENT")
def _(m: Patch) -> bool:
    return not rounds(m, unit=1.9)[1] and rounds(m, unit=2.1)[1]


@decides("ROUNDS")
def _(m: Patch) -> bool:
    return len(rounds(m)[0]) == 7


@decides("SETTLED")
def _(m: Patch) -> bool:
    return len(rounds(m, moves=0.27)[0]) == 2 and len(rounds(m, moves=0.33)[0]) > 2


@decides("SAMPLES")
def _(m: Patch) -> bool:
    return rounds(m)[0][-1] == 300


@decides("SAMPLES_BEFORE")
def _(m: Patch) -> bool:
    return rounds(m)[0][0] == 80


class Asked:
    """Sets that have the same odds whatever is there, and no set that is likelier than the first."""

    def __init__(self, odds: list[float]) -> None:
        self.odds, self.conditionals, self.fits = np.array(odds), 0, 0
        self.groups, self.free, self.share = [None] * len(odds), np.ones(len(odds), bool), np.ones(len(odds))

    def empty(self) -> State:
        return State(np.zeros(self.odds.size))

    def settled(self, state: State) -> State:
        return state

    def fitted(self, state: State) -> Some:
        self.fits += 1
        return Some(score=-float(self.fits))

    def conditional(self, state: State) -> Some:
        self.conditionals += 1
        return Some(log_odds=self.odds, tau_weights=np.ones((self.odds.size, 5)), score=0.0)


@decides("HOPE")
def _(m: Patch) -> bool:
    s = Asked([-5.5, -6.5])
    likely_set.climb(s, s.empty())
    return s.fits == 2


@decides("PATIENCE")
def _(m: Patch) -> bool:
    s = Asked([1.0] * 30)
    likely_set.climb(s, s.empty())
    return s.fits == 1 + 9


@decides("NEEDED")
def _(m: Patch) -> bool:
    kept, tried = Asked([13.0]), Asked([11.0])
    likely_set.thinned(kept)
    likely_set.thinned(tried)
    return kept.conditionals == 1 < tried.conditionals


@decides("LEADERS")
def _(m: Patch) -> bool:
    beside = lambda here: (Asked([1.0] * 30), State(np.zeros(30)))  # noqa: E731
    return len(own(beside=beside)._promising(Some(groups=frozenset()))) == 12


def miswired(m: Patch, start: float, without: float) -> bool:
    m.setattr(wiring, "_other_wavelengths", lambda *a: [])
    m.setattr(wiring, "_mistakes", lambda problem: iter([Some(problem="mended")]))
    m.setattr(wiring, "_left", lambda problem, *at: without if problem == "mended" else start)
    return wiring.miswired(Some(nominal=lambda: ())) is not None


@decides("WIRING")
def _(m: Patch) -> bool:
    return miswired(m, 1000.0, 190.0) and not miswired(m, 1000.0, 210.0)


@decides("DECISIVE")
def _(m: Patch) -> bool:
    return miswired(m, 28.0, 0.5) and not miswired(m, 23.0, 0.5)


@decides("BESIDE_FIELD")
def _(m: Patch) -> bool:
    space = Space(tuple(made(place=str(k)) for k in range(200)))
    found = Some(
        space=space,
        members=[(k,) for k in range(200)],
        samples=Some(best=Some(unit=1.0)),
        sets=Some(conditional=lambda best: Some(log_odds=np.zeros(200))),
    )
    m.setattr(whole_bench, "applied", lambda found, base: (Space(()), np.zeros(0)))
    m.setattr(whole_bench, "score", lambda *a: (1e6, None))
    asked = bench(whole=Some(sums=lambda *a: None), _posterior=lambda candidates, fixed: candidates)
    return len(asked._with_fields(found, [], [made(kind="field")])) == 90 + 1


@decides("GROWTH")
def _(m: Patch) -> bool:
    return judge._grown(np.array([1.06]), 1.0) and not judge._grown(np.array([1.04]), 1.0)


# ---- correction ----------------------------------------------------------------------------------------------------
def takes_part(m: Patch, probabilities: list[float], told: causes.Cause | None = None) -> list[str]:
    space = Space(tuple(made(place=str(k)) for k in range(len(probabilities))))
    found = Some(
        space=space,
        members=[(k,) for k in range(len(probabilities))],
        label=lambda g: space.candidates[g],
        samples=Some(probability=np.array(probabilities)),
        values=np.zeros(space.size),
    )
    names = ()
    if told is not None:
        names = (Some(probability=1.0, candidates=space.candidates[:1], alternatives=space.candidates[1:]),)
    m.setattr(whole_bench, "causes", lambda found, left: names)
    return [c.place for c in whole_bench.applied(found, Space(()))[0].candidates]


@decides("TAKES_PART")
def _(m: Patch) -> bool:
    return takes_part(m, [0.23, 0.27]) == ["1"]


@decides("SHARES")
def _(m: Patch) -> bool:
    return takes_part(m, [0.5, 0.009, 0.011], cause()) == ["0", "2"]


def guarded(m: Patch, rms: float, condition: float) -> bool:
    solved = Some(before=Some(rms=1.0), after=Some(rms=rms), base=None, before_fit=None, space="new", fit=None)
    m.setattr(guard, "predicted_error", lambda problem, found, solved: (0.0, 0.0))
    m.setattr(guard, "_stretch", lambda problem, solved: 1.0)
    m.setattr(guard, "_of_rows", lambda problem, k, space, fit: (16, condition if space == "new" else 1.0))
    return all(c.holds for c in guard.checks(Some(captures=[Some(name="a")]), None, solved))


@decides("WORSE")
def _(m: Patch) -> bool:
    return guarded(m, 1.0019, 1.0) and not guarded(m, 1.0021, 1.0)


@decides("WORSE_CONDITION")
def _(m: Patch) -> bool:
    return guarded(m, 1.0, 1.4) and not guarded(m, 1.0, 1.6)


def without_name(m: Patch, *left: float) -> Empirical | None:
    """The empirical correction where nothing leaves 100 and each of some effects leaves so much."""
    candidates = [made(GeneralEffect, kind=f"k{k}") for k in range(len(left))]
    rest = iter((100.0, *left))
    m.setattr(empirical, "_left", lambda found, index: (next(rest), np.zeros(index.size)))
    found = Some(space=Space(tuple(candidates)), sets=Some(noise=Some(slack=0.0, known=True)))
    solved = Some(space=Space(()), before=Some(excess=100.0, freedom=100.0, rms=0.01))
    return empirical.empirical(found, solved)


@decides("EMPIRICAL_SHARE")
def _(m: Patch) -> bool:
    return without_name(m, 91.0) is None and without_name(m, 89.0) is not None


@decides("ALSO")
def _(m: Patch) -> bool:
    told = without_name(m, 0.0, 2.7, 3.3)
    return told is not None and told.would_also_fit == ("k0", "k1")


# ---- structure and names -------------------------------------------------------------------------------------------
@decides("LIMIT")
def _(m: Patch) -> bool:
    seen = [judge._structure(Some(noise_known=True), [Some(tests={"a": t})]) for t in (4.8, 5.2)]
    return seen == [False, True]


@decides("WHITE")
def _(m: Patch) -> bool:
    turns = [judge._white(Some(mean=np.cos(2 * np.pi * t * np.arange(100) / 100))) for t in (19, 18)]
    return turns == [True, False]


@decides("SURE")
def _(m: Patch) -> bool:
    return [cause(probability=p).answer for p in (0.985, 0.995)] == ["likely", "sure"]


@decides("LIKELY")
def _(m: Patch) -> bool:
    return [cause(probability=p).answer for p in (0.89, 0.91)] == ["unknown", "likely"]


@decides("ALTERNATIVE")
def _(m: Patch) -> bool:
    return causes.least_odds(20.0, 0.0) == 13.0


@decides("ALIKE")
def _(m: Patch) -> bool:
    return causes.least_odds(1e5, 0.0) == 1e5 - 100


@decides("DOUBTED")
def _(m: Patch) -> bool:
    return telling.told_answer(cause(), doubts.PART_OF_LEFT) == ("likely", 0.95)


def tied(correlation: float, ratio: float) -> bool:
    """Whether two values of so much correlation are told together, if their errors along and across have a ratio."""
    covariance = np.array([[1.0, correlation], [correlation, 1.0]])
    if ratio:
        size, vector = np.linalg.eigh(covariance)
        covariance = (vector * [size[1] / ratio**2, size[1]]) @ vector.T
    return bool(list(combinations.ties(np.ones(2), covariance, np.ones(2))))


@decides("TOGETHER")
def _(m: Patch) -> bool:
    m.setattr(combinations, "OPEN", 1.0)
    return not tied(0.89, 0.0) and tied(0.91, 0.0)


@decides("OPEN")
def _(m: Patch) -> bool:
    m.setattr(combinations, "TOGETHER", 0.5)
    return not tied(0.9, 4.8) and tied(0.9, 5.2)


# ---- doubts --------------------------------------------------------------------------------------------------------
@decides("BOUND")
def _(m: Patch) -> bool:
    return [doubts._at_bound(cause(values=[v])) for v in (0.0009, 0.0011)] == [True, False]


@decides("ONE_PATTERN")
def _(m: Patch) -> bool:
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


@decides("UNEVEN")
def _(m: Patch) -> bool:
    return not uneven(m, 11.5, 0.0) and uneven(m, 12.5, 0.0)


@decides("UNEVEN_SHARE")
def _(m: Patch) -> bool:
    return not uneven(m, 1900.0, 1e5) and uneven(m, 2100.0, 1e5)


@decides("TESTABLE")
def _(m: Patch) -> bool:
    problem = Some(powers=lambda: [(100, np.ones(1))], noise_known=False)
    solved = Some(before=Some(excess=0.0))
    told = [cause(candidate=made(ValuePerState, size)) for size in (73, 77)]
    return [doubts.testable(problem, solved, c, [c]) for c in told] == [True, False]


def doubted(odds: float, known: bool, left: float) -> bool:
    found = Some(samples=Some(best=Some(unit=1.0)), sets=Some(noise=Some(directions=1.0)))
    told = cause(odds)
    return told in doubts.doubts(Some(noise_known=known), found, None, [told], left)


@decides("TIMES")
def _(m: Patch) -> bool:
    return doubted(48.0, True, 1.0) and not doubted(52.0, True, 1.0)


@decides("UNKNOWN_NOISE")
def _(m: Patch) -> bool:
    return doubted(24.0, False, 0.0) and not doubted(26.0, False, 0.0)


# ---- what captures can show ----------------------------------------------------------------------------------------
def unseen(candidate: Candidate, information: float, noise: float = 0.0) -> bool:
    sets = Some(form=Quadratic(0.0, np.zeros(1), np.eye(1) * information), groups=[Group(np.array([0]))])
    problem = Some(noise_information=lambda space, values: np.eye(1) * noise)
    return bool(telling.unobservable(problem, Some(space=Space((candidate,)), sets=sets)))


@decides("SEEN")
def _(m: Patch) -> bool:
    return unseen(made(), 3.8) and not unseen(made(), 4.2)


@decides("VISIBLE_FAULT")
def _(m: Patch) -> bool:
    said = []
    for told in (15.0, 17.0):
        sets = Some(form=Quadratic(0.0, np.zeros(1), np.eye(1) * told), groups=[Group(np.array([0]))])
        found = Some(sets=sets, space=Space((made(),)), samples=Some(best=Some(unit=1.0)))
        said.append(bool(evidence.would_be_seen(found)))
    return said == [False, True]


@decides("NOISE_ERROR")
def _(m: Patch) -> bool:
    return unseen(made(ImageShift), 9.5, 200.0) and not unseen(made(ImageShift), 10.5, 200.0)


@decides("APART")
def _(m: Patch) -> bool:
    said = []
    for power in (0.29, 0.31):
        m.setattr(recommend, "_power", lambda *a, p=power: p)
        said.append(recommend._capture(Some(captures=[]), None, None, [made(), made()], []).split()[0])
    return said == ["No", "Capture"]


@decides("VISIBLE")
def _(m: Patch) -> bool:
    axes = np.eye(2)
    return [recommend._sine(s * axes[:, :1], s * axes[:, 1:]) for s in (0.9e-4, 1.1e-4)] == [0.0, 1.0]


# ---- surfaces ------------------------------------------------------------------------------------------------------
def worth(odds: float, left: float) -> bool:
    more = Some(score_at=lambda unit: odds, at_bound=False, left=left)
    return own(left=lambda v: v.left, noise=QUIET)._worth(more, Some(score_at=lambda unit: 0.0, left=100.0))


@decides("IMITATES")
def _(m: Patch) -> bool:
    return worth(21.0, 0.0) and not worth(19.0, 0.0)


@decides("EXPLAINS")
def _(m: Patch) -> bool:
    return worth(100.0, 68.0) and not worth(100.0, 72.0)


@decides("LEFT_OVER")
def _(m: Patch) -> bool:
    return [surface_judge._explains([], [{"a": 1000.0}], [{"a": y}]) for y in (28.0, 32.0)] == [True, False]


@decides("MOST_EFFECTS")
def _(m: Patch) -> bool:
    nothing = [{"a": 0.0}]
    said = [surface_judge._verdict([cause()] * n, nothing, nothing) for n in (3, 4)]
    return said == ["explained", "unexplained"]


@decides("AS_LIKELY")
def _(m: Patch) -> bool:
    problem = Some(captures=[0], rows=lambda k, changes: np.eye(4, 16), changes=lambda *a: (None, None))
    before = [Some(excess=1.0, freedom=1.0, rms=rms) for rms in (0.020, 0.0225)]
    return [surface_judge._degeneracy_in_doubt(problem, Some(before=b, base=None)) for b in before] == [True, False]


@decides("DARK")
def _(m: Patch) -> bool:
    signal = np.ones((1, 1, 200, 200), dtype=np.float32)
    signal[..., 20:80, 20:80], signal[..., 120:180, 120:180] = 0.09, 0.11
    clean = np.zeros((200, 200), dtype=bool)
    data = Some(usable=~clean, clipped=clean, binned=1, name="a")
    view = Some(at=lambda omega: Some(mask=~clean))
    picked = surface_data._pick(data, signal, view, 35.0, 1)
    return not picked[30:70, 30:70].any() and bool(picked[130:170, 130:170].any())


@decides("LEAST_MODULATION")
def _(m: Patch) -> bool:
    said = []
    for square in (3.9, 4.1):
        y = 10.0 + np.sqrt(square) / 2 * np.array([[1.0, -1.0, 1.0, -1.0]])
        tile = Some(variance=np.ones((1, 4)), y=y, tile=np.zeros(1, dtype=int))
        said.append(bool(surface_data.SurfaceData.polarized(tile, np.ones(4))[0]))
    return said == [False, True]


def test_every_constant_has_its_decision() -> None:
    assert set(DECIDED) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_decision_is_another_one_with_another_constant(name: str, monkeypatch: Patch) -> None:
    value = getattr(rules, name)
    changed = [value - 1, value + 1] if isinstance(value, int) else [0.8 * value, 1.25 * value]
    with monkeypatch.context() as m:
        assert DECIDED[name](m)
    for other in changed:
        with monkeypatch.context() as m:
            for module in MODULES:
                if hasattr(module, name):
                    m.setattr(module, name, other)
            assert not DECIDED[name](m), f"{name} = {other} decides as {value} does"


def test_the_page_lists_them_as_they_are() -> None:
    assert rules_page.PAGE.read_text() == rules_page.page()
