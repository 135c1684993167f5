"""Promises 4 and 5: an axis that stalls or is silent ends the run; a bad reply never becomes a position."""

import itertools

import pytest

from drivers.errors import DeviceError, MotionFailed
from simulators.clock import patient_clock
from simulators.serial.reply_faults import Fault


def _at(state, *faults, port="rotators"):
    def act(rig, number, retake):
        if number == state and retake == 0:
            rig.simulation.emulators[port].faults.add(*faults)

    return act


@pytest.mark.parametrize("kind", ["stuck", "silent"])
def test_stalled_or_silent_axis_ends_the_run_and_names_everything(run_with, intact, kind):
    start_s = patient_clock().now_s()
    error, path = run_with(_at(10, Fault(kind)))
    assert isinstance(error, DeviceError)
    assert patient_clock().now_s() - start_s < 30
    if kind == "stuck":
        assert isinstance(error, MotionFailed)
        assert error.axis in ("psg", "psa")
        assert error.target_deg is not None
        assert error.allowed_s > 0
        for word in (error.axis, f"{error.target_deg:.4f}", "last position", "allowed"):
            assert word in str(error)
    assert path.name == "run.h5.partial"
    assert 9 <= intact(path) <= 11


def test_slow_axis_is_given_the_time_that_distance_and_speed_allow(run_with, intact):
    # The clock runs 50 times fast, so an axis at a tenth of its speed is still early.
    error, path = run_with(_at(10, Fault("slow", amount=0.1)))
    assert error is None
    assert intact(path) == 19


#: The conformance kit asks the same of the driver of each kind of axis.
ONE_OF_EACH = {("garbled", "arm"), ("late", "rotators"), ("foreign", "shutter")}


@pytest.mark.parametrize(
    ("kind", "port"),
    [
        pytest.param(*case, marks=[pytest.mark.long] * (case not in ONE_OF_EACH))
        for case in itertools.product(("garbled", "late", "foreign"), ("rotators", "arm", "shutter"))
    ],
)
def test_one_bad_reply_never_becomes_a_wrong_angle(run_with, intact, kind, port):
    """One spoiled reply is overcome or ends the run; either way every angle recorded is true."""
    faults = [Fault(kind, from_command=number, commands=1) for number in (3, 40, 77)]
    error, path = run_with(_at(6, *faults, port=port))
    done = intact(path)
    assert done == 19 if error is None else done >= 5


def test_lost_reference_in_mid_run_is_refused(run_with, intact):
    error, path = run_with(_at(10, Fault("not_homed")))
    assert isinstance(error, DeviceError)
    assert "reference" in str(error) or "off its target" in str(error)
    assert intact(path) <= 11
