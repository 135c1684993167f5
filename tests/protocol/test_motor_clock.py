"""The trapezoid of an emulated motor, its clock, and the schedule of faults."""

import itertools
import math
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulators.clock import LONGEST_BEAT_S, FastClock, ManualClock, PatientClock, TrapezoidMotion, patient_clock
from simulators.serial.emulator import EmulatedAxis
from simulators.serial.reply_faults import Fault, FaultSchedule, parse_fault

angles = st.floats(-1e4, 1e4)
positive = st.floats(0.1, 1e3)


@given(angles, angles, positive, positive)
def test_trapezoid_is_continuous_and_keeps_its_speed_and_acceleration(
    start: float, target: float, speed: float, acceleration: float
) -> None:
    motion = TrapezoidMotion(start, target, speed, acceleration, start_s=3.0)
    assert motion.position(2.9) == start
    assert motion.position(3.0 + motion.duration_s + 1e-9) == target
    steps = 400
    step_s = motion.duration_s / steps
    positions = [motion.position(3.0 + index * step_s) for index in range(steps + 1)]
    scale = abs(target - start) + 1e-12
    for before, after in itertools.pairwise(positions):
        assert abs(after - before) <= speed * step_s * (1 + 1e-6) + 1e-9 * max(1.0, abs(start), abs(target))
        assert (after - before) * (target - start) >= -1e-9 * scale * max(1.0, abs(start))
    middle_s = 3.0 + motion.duration_s / 2
    assert motion.position(middle_s) == pytest.approx(
        (start + target) / 2, abs=1e-9 * max(1.0, abs(start) + abs(target))
    )
    assert abs(motion.velocity(middle_s)) == pytest.approx(motion.peak_speed)


def test_trapezoid_by_hand() -> None:
    # 100 deg at 20 deg/s with 10 deg/s^2: 2 s up over 20 deg, 3 s flat over 60 deg, 2 s down.
    motion = TrapezoidMotion(0.0, 100.0, 20.0, 10.0)
    assert motion.duration_s == 7.0
    assert [motion.position(t) for t in (1.0, 2.0, 3.5, 5.0, 6.0)] == [5.0, 20.0, 50.0, 80.0, 95.0]
    # 10 deg never reach the speed: 1 s up, 1 s down.
    assert TrapezoidMotion(0.0, -10.0, 20.0, 10.0).duration_s == 2.0


def test_a_stopped_axis_brakes_along_its_acceleration() -> None:
    clock = ManualClock()
    axis = EmulatedAxis(clock, speed_deg_s=20.0, acceleration_deg_s2=10.0, homed=True)
    axis.move_to(100.0)
    clock.sleep_s(3.0)
    assert axis.position_deg() == pytest.approx(40.0)
    axis.stop()
    assert axis.position_deg() == pytest.approx(40.0)
    clock.sleep_s(1.0)
    assert axis.position_deg() == pytest.approx(55.0)
    clock.sleep_s(1.0)
    assert not axis.is_moving()
    assert axis.position_deg() == pytest.approx(60.0)


def test_the_true_angle_stays_behind_the_reported_one() -> None:
    clock = ManualClock()
    wobble = EmulatedAxis(clock, homed=True, true_angle=lambda deg: deg + 0.5 + 0.1 * math.sin(math.radians(deg)))
    wobble.move_to(90.0)
    clock.sleep_s(10.0)
    assert wobble.position_deg() == 90.0
    assert wobble.true_deg() == pytest.approx(90.6)


def test_without_a_reference_the_reported_angle_is_only_relative() -> None:
    clock = ManualClock()
    axis = EmulatedAxis(clock, start_deg=33.0)
    assert (axis.position_deg(), axis.true_deg(), axis.homed) == (0.0, 33.0, False)
    axis.home()
    clock.sleep_s(10.0)
    assert (axis.position_deg(), axis.true_deg(), axis.homed) == (0.0, 0.0, True)
    axis.move_to(725.0)
    clock.sleep_s(10.0)
    axis.home()
    clock.sleep_s(10.0)
    assert axis.position_deg() == 0.0
    assert axis.true_deg() % 360.0 == 0.0
    axis.lose_reference()
    assert not axis.homed


def test_clocks_run_fast_or_jump() -> None:
    base = ManualClock()
    fast = FastClock(1000.0, base=base)
    fast.sleep_s(10.0)
    assert base.now_s() == pytest.approx(0.01)
    assert fast.now_s() == pytest.approx(10.0)
    instant = EmulatedAxis(FastClock(instant=True), homed=True)
    instant.move_to(1e5)
    assert not instant.is_moving()
    assert instant.position_deg() == 1e5
    with pytest.raises(ValueError, match="positive"):
        FastClock(0.0)


def test_a_patient_clock_leaves_out_the_time_in_which_not_all_were_there() -> None:
    real_s = [100.0]
    clock = PatientClock(lambda: real_s[0])
    with clock.attend() as first, clock.attend() as second:
        for _ in range(100):
            real_s[0] += LONGEST_BEAT_S / 2
            first()
            second()
        on_time_s = 50 * LONGEST_BEAT_S
        assert clock.now_s() == pytest.approx(on_time_s)
        # All are kept from running for ten seconds.
        real_s[0] += 10.0
        assert clock.now_s() == pytest.approx(on_time_s + LONGEST_BEAT_S)
        first()
        second()
        real_s[0] += LONGEST_BEAT_S / 2
        assert clock.now_s() == pytest.approx(on_time_s + 1.5 * LONGEST_BEAT_S)
        # One of them alone is.
        for _ in range(100):
            real_s[0] += LONGEST_BEAT_S / 2
            first()
        assert clock.now_s() == pytest.approx(on_time_s + 2 * LONGEST_BEAT_S)
    # Who has left is not waited for.
    real_s[0] += LONGEST_BEAT_S / 2
    assert clock.now_s() == pytest.approx(on_time_s + 2.5 * LONGEST_BEAT_S)


def test_the_patient_clock_of_this_process_goes_and_waits() -> None:
    clock = patient_clock()
    assert clock is patient_clock()
    start_s, real_s = clock.now_s(), time.monotonic()
    clock.sleep_s(0.05)
    assert clock.now_s() - start_s >= 0.05
    assert time.monotonic() - real_s >= 0.05
    clock.sleep_s(-1.0)


def test_faults_take_effect_when_they_are_due() -> None:
    schedule = FaultSchedule([Fault("silent", from_command=2, commands=2), Fault("slow", from_s=5.0, amount=0.25)])
    active = [sorted(schedule.count_command(now_s)) for now_s in (0.0, 0.0, 0.0, 0.0, 6.0)]
    assert active == [[], ["silent"], ["silent"], [], ["slow"]]
    assert schedule.active["slow"].size() == 0.25
    schedule.clear()
    assert schedule.count_command(7.0) == {}


@given(st.binary(min_size=1, max_size=40), st.integers(0, 1000))
def test_garbling_changes_exactly_one_byte_and_repeats_with_the_seed(reply: bytes, seed: int) -> None:
    changed = FaultSchedule(seed=seed).garble(reply)
    assert sum(a != b for a, b in zip(reply, changed, strict=True)) == 1
    assert changed == FaultSchedule(seed=seed).garble(reply)


def test_faults_are_read_from_text() -> None:
    assert parse_fault("silent") == Fault("silent")
    assert parse_fault("garbled@12x1") == Fault("garbled", from_command=12, commands=1)
    assert parse_fault("slow@3.5s:0.2") == Fault("slow", from_s=3.5, amount=0.2)
    for text in ("loud", "silent@", "silent@3y", "", "slow:"):
        with pytest.raises(ValueError, match="expected KIND"):
            parse_fault(text)
