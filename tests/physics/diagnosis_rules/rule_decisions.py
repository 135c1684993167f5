"""What the tests of the constants of processing/diagnosis/search/rules.py share."""

from collections.abc import Callable
from importlib import import_module
from pkgutil import walk_packages
from types import SimpleNamespace as Some

import numpy as np
import pytest

import processing.diagnosis
from processing.diagnosis.instrument import whole_bench
from processing.diagnosis.search import causes, rules
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space
from processing.effect import Parameter

MODULES = [import_module(m.name) for m in walk_packages(processing.diagnosis.__path__, "processing.diagnosis.")]
QUIET = Noise(known=True, directions=30.0, slack=1e9)
Patch = pytest.MonkeyPatch


def decides(decision: Callable[[Patch], bool]) -> Callable[[Patch], None]:
    """Test of the constant that `decision` is named for: it holds as the rules are, and not with another value.

    The constant is changed by a fifth down and up, a whole number by one, wherever the diagnosis uses it.
    """
    name = decision.__name__.removeprefix("test_").upper()

    def test(monkeypatch: Patch) -> None:
        value = getattr(rules, name)
        changed = [value - 1, value + 1] if isinstance(value, int) else [0.8 * value, 1.25 * value]
        with monkeypatch.context() as m:
            assert decision(m)
        users = [module for module in MODULES if getattr(module, name, None) is value]
        for other in changed:
            with monkeypatch.context() as m:
                for module in users:
                    m.setattr(module, name, other)
                assert not decision(m), f"{name} = {other} decides as {value} does"

    return test


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


class Asked:
    """Sets that have the same odds whatever is there, and no set that is likelier than the first."""

    def __init__(self, odds: list[float]) -> None:
        self.odds, self.conditionals, self.fits = np.array(odds), 0, 0
        self.groups, self.free, self.share = [None] * len(odds), np.ones(len(odds), bool), np.ones(len(odds))
        self.taus, self.many = rules.TAU, np.zeros(len(odds), bool)

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
