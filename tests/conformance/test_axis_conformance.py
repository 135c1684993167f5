"""What every kind of axis must do on its emulator. A new kind inherits these tests by being in the two folders."""

import contextlib
import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from drivers.errors import (
    CommandRejected,
    DeviceError,
    LimitError,
    MotionFailed,
    MotionStopped,
    NotHomedError,
    PortBusy,
    PortNotFound,
    ReplyError,
    ReplyTimeout,
    WrongDevice,
)
from drivers.motion import AxisConfig, MotionAxis
from drivers.registry import device_kinds, open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import Clock, patient_clock
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.reply_faults import Fault, FaultSchedule
from simulators.serial.serve_options import ServeOptions
from simulators.serial.tcp_port import TcpPort, port_for

MOTION_KINDS = [kind for kind, make in served_kinds().items() if axis_configs(make(ServeOptions()), "none")]
# A controller on the network takes several programs at once.
SERIAL_KINDS = [kind for kind in MOTION_KINDS if not hasattr(served_kinds()[kind](ServeOptions()), "connect")]
SHARED_LINES = [kind for kind in MOTION_KINDS if not kind.startswith("apt")]
# These controllers do not tell limits of their own: only the rig file's hold.
KEEPS_NO_LIMITS = {"elliptec", "apt-k10cr1", "apt-kdc101", "apt-kbd101"}
WIDE = (-1000.0, 1000.0)
FAST = 200.0


@dataclass
class Bench:
    """An emulator behind a port, and the rig entries that open it."""

    emulator: Emulator
    port: PtyPort | TcpPort
    lines: LineRegistry
    configs: list[AxisConfig]

    def open(self, index: int = 0, **changes: object) -> MotionAxis:
        """Open an axis with short waits, as the emulator is fast."""
        config = self.configs[index]
        short = {"poll_s": 0.002, "margin_s": 0.3, "stall_s": 0.3, "reply_s": 0.25, "pause_before_move_s": 0.0}
        known = {name: value for name, value in short.items() if name in type(config).model_fields}
        config = config.model_copy(update=known | changes)
        return open_axis(f"axis{index}", type(config).model_validate(config.model_dump()), self.lines)


@contextlib.contextmanager
def served(kind: str, homed: bool = True, speed: float = FAST, **options: object) -> Iterator[Bench]:
    """Serve one kind; homed by default, so that a test need not wait for homing."""
    options = {"limits_deg": WIDE, "faults": FaultSchedule(seed=7)} | options
    emulator = served_kinds()[kind](ServeOptions(homed=homed, clock=Clock(speed, base=patient_clock()), **options))  # type: ignore[arg-type]
    with port_for(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        yield Bench(emulator, port, lines, axis_configs(emulator, port.path, homed=homed))


@pytest.fixture(params=MOTION_KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_every_kind_of_axis_has_an_emulator() -> None:
    covered = set()
    for kind in MOTION_KINDS:
        configs = axis_configs(served_kinds()[kind](ServeOptions()), "none")
        covered |= {config.kind for config in configs}  # type: ignore[attr-defined]
    assert covered == set(device_kinds("axes"))


def test_opening_moves_nothing_and_tells_that_it_is_not_homed(kind: str) -> None:
    with served(kind, homed=False) as bench:
        before = [axis.true_deg() for axis in bench.emulator.axes]
        axis = bench.open()
        assert not axis.may_move_on_connect
        assert not axis.is_homed()
        assert not axis.is_moving()
        with pytest.raises(NotHomedError, match="home the axis"):
            axis.start_move(10.0)
        time.sleep(0.02)
        assert [axis.true_deg() for axis in bench.emulator.axes] == before
        assert all(axis.end_s() <= bench.emulator.clock.now_s() for axis in bench.emulator.axes)


def test_identity_is_read_from_the_device(kind: str) -> None:
    with served(kind) as bench:
        identity = bench.open().describe()
        assert identity.kind == bench.configs[0].kind  # type: ignore[attr-defined]
        assert identity.port == bench.port.path
        assert identity.model
        assert identity.serial_number
        assert identity.firmware


def test_homing_gives_a_reference_and_can_be_repeated(kind: str) -> None:
    with served(kind, homed=False) as bench:
        axis = bench.open()
        for _ in range(2):
            position = axis.home().wait()
            assert axis.is_homed()
            assert position.deg == pytest.approx(0.0, abs=0.01)
            assert bench.emulator.true_deg(0) == pytest.approx(0.0, abs=0.01)
            axis.start_move(5.0).wait()
        axis.close()


def test_moves_are_read_back_in_degrees_and_counts(kind: str) -> None:
    with served(kind) as bench:
        axis = bench.open()
        for target_deg in (9.0, -44.19, 372.5, 900.25, -0.01, 0.0):
            position = axis.start_move(target_deg).wait()
            assert position.deg == pytest.approx(target_deg, abs=axis.config.tolerance_deg)
            assert position.deg == pytest.approx(bench.emulator.true_deg(0), abs=1e-3)
            assert position.deg == pytest.approx(position.counts / axis.counts_per_deg, abs=1e-9)
            assert axis.read_position() == position
            assert not axis.is_moving()


@pytest.mark.parametrize(("zero_deg", "direction"), [(12.5, 1), (-3.25, -1)])
def test_one_zero_and_one_direction(kind: str, zero_deg: float, direction: int) -> None:
    with served(kind) as bench:
        axis = bench.open(zero_deg=zero_deg, direction=direction, limits_deg=(-400.0, 500.0))
        assert axis.limits.min_deg == -400.0
        assert axis.limits.max_deg == 500.0
        position = axis.start_move(40.0).wait()
        assert position.deg == pytest.approx(40.0, abs=0.05)
        assert bench.emulator.true_deg(0) == pytest.approx(direction * 40.0 + zero_deg, abs=0.05)


def test_targets_outside_the_limits_are_refused_without_a_byte(kind: str) -> None:
    with served(kind) as bench:
        axis = bench.open(limits_deg=(-10.0, 20.0))
        before = bench.emulator.faults.commands
        for target_deg in (20.5, -10.5, 1e9, math.nan, math.inf, -math.inf):
            with pytest.raises(LimitError, match="limits are -10 to 20 deg"):
                axis.check(target_deg)
            with pytest.raises(LimitError):
                axis.start_move(target_deg)
        axis.check(20.0)
        assert bench.emulator.faults.commands == before
        assert axis.start_move(20.0).wait().deg == pytest.approx(20.0, abs=0.05)


def test_limits_of_the_controller_count_as_well(kind: str) -> None:
    with served(kind, limits_deg=(0.0, 90.0)) as bench:
        axis = bench.open(zero_deg=10.0, direction=-1)
        if kind in KEEPS_NO_LIMITS:
            assert (axis.limits.min_deg, axis.limits.max_deg) == (None, None)
            return
        assert axis.limits.min_deg == pytest.approx(-80.0, abs=0.001)
        assert axis.limits.max_deg == pytest.approx(10.0, abs=0.001)
        with pytest.raises(LimitError):
            axis.start_move(10.1)


def test_two_moves_at_once_on_one_axis_are_refused(kind: str) -> None:
    with served(kind, speed=3.0) as bench:
        axis = bench.open()
        motion = axis.start_move(60.0)
        assert not motion.done()
        with pytest.raises(CommandRejected, match="still moving"):
            axis.start_move(0.0)
        assert motion.wait().deg == pytest.approx(60.0, abs=0.05)


def test_stop_from_another_thread(kind: str, caplog: pytest.LogCaptureFixture) -> None:
    with served(kind, speed=1.0) as bench:
        axis = bench.open()
        # So far that nobody arrives before the stop, however late the thread gets to run.
        far_deg = 900.0 if axis.can_stop_a_move else 120.0
        motion = axis.start_move(far_deg)

        def stop_on_the_way() -> None:
            while bench.emulator.true_deg(0) < 5.0:
                time.sleep(0.005)
            axis.stop()

        stopper = threading.Thread(target=stop_on_the_way)
        stopper.start()
        if axis.can_stop_a_move:
            with pytest.raises(MotionStopped, match="stopped on request"):
                motion.wait()
            assert not axis.is_moving()
            assert 5.0 < axis.read_position().deg < far_deg / 2
        else:
            with caplog.at_level(logging.WARNING):
                assert motion.wait().deg == pytest.approx(120.0, abs=0.05)
            assert "cannot be stopped" in caplog.text
        stopper.join()
        # The axis is usable afterwards.
        assert axis.start_move(1.0).wait().deg == pytest.approx(1.0, abs=0.05)


def test_a_stuck_axis_fails_in_bounded_time_and_is_named(kind: str) -> None:
    with served(kind) as bench:
        axis = bench.open(margin_s=0.1, stall_s=0.1)
        axis.start_move(10.0).wait()
        bench.emulator.faults.add(Fault("stuck"))
        motion = axis.start_move(20.0)
        with pytest.raises(MotionFailed, match=r"axis axis0, move to 20.0000 deg: .*allowed") as caught:
            motion.wait()
        error = caught.value
        assert (error.axis, error.target_deg) == ("axis0", 20.0)
        assert error.elapsed_s < motion.allowed_s + 0.5
        assert error.last_deg == pytest.approx(10.0, abs=0.05)
        with pytest.raises(MotionFailed):
            motion.wait()


def test_a_slow_axis_fails_at_the_deadline(kind: str) -> None:
    with served(kind) as bench:
        axis = bench.open(margin_s=0.05, stall_s=5.0)
        bench.emulator.faults.add(Fault("slow", amount=1e-5))
        motion = axis.start_move(20.0)
        with pytest.raises(MotionFailed, match="deadline"):
            motion.wait()


def test_a_silent_device_fails_with_the_reason(kind: str) -> None:
    with served(kind, speed=2.0) as bench:
        axis = bench.open(reply_s=0.15)
        motion = axis.start_move(90.0)
        bench.emulator.faults.add(Fault("silent"))
        with pytest.raises(MotionFailed, match="nothing within") as caught:
            motion.wait()
        assert isinstance(caught.value.__cause__, ReplyTimeout)
        with pytest.raises(ReplyTimeout, match="power"):
            axis.read_position()
        bench.emulator.faults.clear()
        while bench.emulator.axes[0].is_moving():
            time.sleep(0.01)
        assert axis.read_position().deg == pytest.approx(bench.emulator.true_deg(0), abs=0.01)


@pytest.mark.parametrize("fault", ["garbled", "late", "foreign", "silent"])
def test_a_passing_fault_never_gives_a_wrong_position(kind: str, fault: str) -> None:
    """One spoiled reply, at every place of the exchange: the move ends right, or with an error."""
    right = 0
    with served(kind) as bench:
        axis = bench.open(reply_s=0.1)
        for place in range(1, 13) if fault == "garbled" else (1, 4, 7, 10):
            bench.emulator.faults.add(Fault(fault, from_command=place, commands=1, amount=0.13))  # type: ignore[arg-type]
            target_deg = 7.0 * place
            try:
                position = axis.start_move(target_deg).wait()
            except DeviceError:
                patient_clock().sleep_s(0.15)
                if not axis.is_homed():
                    break
                continue
            finally:
                bench.emulator.faults.clear()
            right += 1
            assert position.deg == pytest.approx(target_deg, abs=0.05)
            assert position.deg == pytest.approx(bench.emulator.true_deg(0), abs=1e-3)
    assert right >= 3


@pytest.mark.parametrize("fault", ["garbled", "foreign"])
def test_a_lasting_fault_ends_in_an_error(kind: str, fault: str) -> None:
    with served(kind) as bench:
        axis = bench.open(reply_s=0.1)
        bench.emulator.faults.add(Fault(fault))  # type: ignore[arg-type]
        with pytest.raises((ReplyError, ReplyTimeout, MotionFailed)):
            axis.start_move(33.0).wait()


def test_a_reset_in_mid_run_is_noticed(kind: str) -> None:
    with served(kind) as bench:
        axis = bench.open()
        axis.start_move(30.0).wait()
        bench.emulator.faults.add(Fault("not_homed"))
        axis.read_position()
        with pytest.raises(NotHomedError):
            axis.start_move(40.0)
        assert bench.emulator.true_deg(0) == pytest.approx(30.0, abs=0.05)


@pytest.mark.parametrize("kind", SHARED_LINES)
def test_two_axes_on_one_line_move_at_once(kind: str) -> None:
    with served(kind, speed=2.0, axes=2) as bench:
        first, second = bench.open(0), bench.open(1)
        motions = [first.start_move(150.0), second.start_move(-150.0)]
        assert first.is_moving()
        assert second.is_moving()
        results: list[float] = []
        threads = [threading.Thread(target=lambda m=motion: results.append(m.wait().deg)) for motion in motions]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(results) == pytest.approx([-150.0, 150.0], abs=0.05)
        assert bench.emulator.true_deg(1) == pytest.approx(-150.0, abs=0.05)
        first.close()
        assert second.read_position().deg == pytest.approx(-150.0, abs=0.05)


@pytest.mark.parametrize("kind", SERIAL_KINDS)
def test_a_port_that_another_program_holds_is_refused_by_name(kind: str) -> None:
    with served(kind) as bench:
        holder = "import os, sys; f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print('open', flush=True); input()"
        with subprocess.Popen(
            [sys.executable, "-c", holder, bench.port.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "open\n"
            with pytest.raises(PortBusy, match=rf"python.*\(pid {process.pid}\)"):
                bench.open()
            process.communicate("\n")
        assert bench.emulator.faults.commands == 0
        bench.open()
        with LineRegistry(clock=patient_clock()) as other, pytest.raises(PortBusy, match=rf"pid {os.getpid()}"):
            open_axis("second", bench.configs[0], other)


def test_a_port_that_vanishes_and_one_that_is_not_there(kind: str) -> None:
    with served(kind) as bench:
        axis = bench.open()
        with pytest.raises(PortNotFound, match="no such port"):
            bench.open(port="/dev/ttyUSB_none")
        bench.port.close()
        with pytest.raises(DeviceError, match="gone"):
            axis.read_position()
        axis.close()
        axis.close()


def test_another_device_than_the_rig_file_names_is_refused(kind: str) -> None:
    with served(kind) as bench:
        fields = type(bench.configs[0]).model_fields
        wrong = {"stage_id": "WRONG"} if "stage_id" in fields else {"serial_number": 99}
        if "group" in fields:
            wrong = {"group": "NotThere"}
        if "serial_number" in fields and "str" in str(fields["serial_number"].annotation):
            wrong = {"serial_number": "00000099"}
        with pytest.raises(WrongDevice, match="rig file"):
            bench.open(**wrong)
        # The line is free again.
        bench.open()
