"""Of the linearizations of a search the likeliest counts that the data bear out."""

from types import SimpleNamespace as Some

import numpy as np
import pytest

from processing.diagnosis.search import posterior
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space
from processing.effect import Parameter

PLACES = "xy"


@pytest.fixture
def space() -> Space:
    effect = Some(kind="it")
    return Space(tuple(Candidate(effect, place, (Parameter("p", "1", -99.0, 99.0, 1.0),)) for place in PLACES))


class Rounds:
    """Round n has the n-th score, and the n-th excess where no structure is left below 10; each goes to the next."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, scores: list[float], excess: list[float] | None = None) -> None:
        self.scores, self.excess = scores, excess or [0.0] * len(scores)
        self.asked, self.about = 0, []
        self.problem = Some(relinearize=lambda space, x: self.about.append(int(x[0])))
        monkeypatch.setattr(posterior, "next_values", lambda problem, space, sets, state, x: (x + 1, False))

    def look(self, x: np.ndarray) -> posterior._Round:
        n = int(x[0])
        self.asked = max(self.asked, n)
        noise = Noise(True, 1.0, slack=10.0)
        sets = Some(
            noise=noise,
            form=Quadratic(0.0, np.zeros(2), np.zeros((2, 2))),
            fitted=lambda state: Some(score=self.scores[n]),
        )
        return posterior._Round(x, self.excess[n], sets, State(np.zeros(2)))

    def last(self, space: Space) -> int:
        return int(
            posterior._settled(self.problem, space, self.look(np.zeros(2)), self.look, len(self.scores)).about[0]
        )


def test_values_that_wander_on_end_with_the_likeliest_round(monkeypatch, space):
    found = Rounds(monkeypatch, [100.0, 110.0, 90.0, 120.0])
    assert found.last(space) == 1
    assert found.asked == 2
    assert found.about[-1] == 1


def test_a_small_loss_is_no_end(monkeypatch, space):
    assert Rounds(monkeypatch, [100.0, 97.0, 130.0]).last(space) == 2


def test_a_score_that_the_counts_do_not_bear_out_counts_for_nothing(monkeypatch, space):
    """About nothing a straight line can promise much; what was promised is not there where it leads."""
    assert Rounds(monkeypatch, [900.0, 100.0, 110.0], [0.0, 5000.0, 0.0]).last(space) == 2


@pytest.mark.parametrize(("without", "likelier"), [(60.0, True), (40.0, False)])
def test_one_of_many_alternatives_is_left_where_less_is_likelier(monkeypatch, space, without, likelier):
    """About an axis that slipped by degrees no straight line leads back to nothing."""
    form = Quadratic(0.0, np.zeros(2), np.eye(2))
    sets = Sets(form, [Group(np.array([0])), Group(np.array([1]), share=80.0)], Noise(True, 1.0))
    found = Some(about=np.ones(2), sets=sets, state=State(np.ones(2)), score=50.0)
    asked = []

    def minimum(problem, space, sets, state):
        asked.append(state.tau.tolist())
        return np.zeros(2)

    monkeypatch.setattr(posterior, "minimum_of", minimum)
    monkeypatch.setattr(posterior, "_settled", lambda problem, space, first, look, rounds: first)
    other = Some(score=without)
    problem = Some(relinearize=lambda space, x: None)
    assert (posterior._without_alternatives(problem, space, found, lambda x: other, 7) is other) is likelier
    assert asked == [[1.0, 0.0]]


@pytest.mark.parametrize(("second", "best", "others"), [(80.0, 1, ()), (45.0, 0, (1,)), (52.0, 1, (0,)), (20.0, 0, ())])
def test_another_bend_is_asked_about_its_own_values(monkeypatch, space, second, best, others):
    """About one bend another looks worse than it is; both are told where they do as well."""
    form = Quadratic(0.0, np.zeros(2), np.eye(2))
    sets = Sets(form, [Group(np.array([0])), Group(np.array([1]))], Noise(True, 1.0))
    rounds = [
        Some(about=np.full(2, k), sets=sets, state=State(np.eye(2)[k]), score=s) for k, s in ((0, 50.0), (1, second))
    ]
    asked = []

    def minimum(problem, space, sets, state):
        asked.append(state.tau.tolist())
        return np.zeros(2)

    monkeypatch.setattr(posterior, "minimum_of", minimum)
    problem = Some(relinearize=lambda space, x: None)
    found, beside = posterior._of_bends(problem, space, rounds[0], [0, 1], lambda x: rounds[1])
    assert found is rounds[best]
    assert beside == {best: others}
    assert asked == [[0.0, 1.0]]
