"""One judge for instrument and surface: the verdict of names and structure, and what is applied."""

from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.decision import Judgement
from processing.diagnosis.search.fit import Fit, Solution
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
    monkeypatch.setattr(quantities, "xi0_of", lambda *of: np.full(5, np.nan))
    assert quantities.chances(problem, solved, np.eye(1)) == ()
    monkeypatch.setattr(quantities, "xi0_of", lambda problem, k, space, values: np.append(0.1 * values, np.nan))
    change = quantities.change_of_xi0(problem, solved, 0.01 * np.eye(1))
    assert (change.size, change.stderr) == pytest.approx((0.1, 0.0071), abs=1e-4)
