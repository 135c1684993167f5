"""The operator is asked for what changed, and only for that; without anybody to ask the run refuses."""

import os

import pytest

from acquisition.capture.operator import Operator
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError, Stopped
from acquisition.stop_request import StopRequest

FIRST = MeasurementPlan()
NEXT_ANGLE = FIRST.with_changes(omega_deg=50)
NEXT_COLOUR = FIRST.with_changes(wavelength_nm=451)


def test_only_changes_are_asked_for():
    questions = []
    operator = Operator(questions.append, StopRequest(), yes=True, simulated=False)
    assert len(operator.prepare(FIRST, source_selects=False)) == 3
    assert operator.prepare(NEXT_ANGLE, source_selects=False) == []
    (change,) = operator.prepare(NEXT_COLOUR, source_selects=False)
    assert "451" in change
    assert "451" in questions[-1]


def test_a_source_that_selects_its_wavelength_is_not_asked_for():
    operator = Operator(lambda text: None, StopRequest(), yes=True, simulated=False)
    operator.prepare(FIRST, source_selects=True)
    assert operator.prepare(NEXT_COLOUR, source_selects=True) == []


def test_nobody_to_ask_is_an_error(monkeypatch):
    reading, writing = os.pipe()
    with os.fdopen(reading) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        operator = Operator(lambda text: None, StopRequest(), yes=False, simulated=False)
        with pytest.raises(AcquisitionError, match="--yes"):
            operator.prepare(FIRST, source_selects=False)
    os.close(writing)


def test_enter_answers_and_a_stop_ends_the_wait(monkeypatch):
    import pty

    master, slave = pty.openpty()
    with os.fdopen(slave) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        stop = StopRequest()
        operator = Operator(lambda text: os.write(master, b"\n"), stop, yes=False, simulated=False)
        assert len(operator.prepare(FIRST, source_selects=False)) == 3
        silent = Operator(lambda text: stop.request(), stop, yes=False, simulated=False)
        with pytest.raises(Stopped):
            silent.prepare(FIRST, source_selects=False)
    os.close(master)
