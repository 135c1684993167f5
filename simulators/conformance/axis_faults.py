"""Requirements of every axis under faults: an error in bounded time that names it, and never a wrong position."""

import time

import pytest

from drivers.errors import DeviceError, MotionFailed, NotHomedError, PortNotFound, ReplyError, ReplyTimeout, WrongDevice
from simulators.clock import patient_clock
from simulators.conformance.served_axes import FAST, AxisTests
from simulators.serial.reply_faults import Fault


class AxisFaults(AxisTests):
    """Tests of an axis on an emulator that is stuck, slow, silent, disturbed, reset or another one."""

    def test_another_device_than_the_rig_file_names_is_refused(self, kind: str) -> None:
        with self.served(kind) as served:
            field = type(served.configs[0]).identified_by
            with pytest.raises(WrongDevice, match="rig file"):
                served.open(0, **{field: "00000099"})
            # The line is free again.
            served.open()

    def test_a_port_that_vanishes_and_one_that_is_not_there(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open()
            with pytest.raises(PortNotFound, match="no such port"):
                served.open(port="/dev/ttyUSB_none")
            served.port.close()
            with pytest.raises(DeviceError, match="gone"):
                axis.read_position()
            axis.close()
            axis.close()

    def test_a_stuck_axis_fails_in_bounded_time_and_is_named(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open(margin_s=0.1, stall_s=0.1)
            axis.start_move(10.0).wait()
            served.emulator.faults.add(Fault("stuck"))
            motion = axis.start_move(20.0)
            with pytest.raises(MotionFailed, match=r"axis axis0, move to 20.0000 deg: .*allowed") as caught:
                motion.wait()
            error = caught.value
            assert (error.axis, error.target_deg) == ("axis0", 20.0)
            assert error.elapsed_s < motion.allowed_s + 0.5
            assert error.last_deg == pytest.approx(10.0, abs=0.05)
            with pytest.raises(MotionFailed):
                motion.wait()

    def test_a_slow_axis_fails_at_the_deadline(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open(margin_s=0.05, stall_s=5.0)
            served.emulator.faults.add(Fault("slow", amount=1e-5))
            motion = axis.start_move(20.0)
            with pytest.raises(MotionFailed, match="deadline"):
                motion.wait()

    def test_one_late_answer_spoils_no_opening(self, kind: str) -> None:
        """On a busy machine: one answer behind the wait for it, at every place of the opening."""
        with self.served(kind) as served:
            description = served.open().describe()
            commands = served.emulator.faults.commands
            served.lines.close()
            for place in range(1, commands + 1):
                served.emulator.faults.add(Fault("late", from_command=place, commands=1, amount=0.22))
                assert served.open(reply_s=0.1).describe() == description
                served.emulator.faults.clear()
                served.lines.close()

    def test_a_silent_device_fails_with_the_reason(self, kind: str) -> None:
        with self.served(kind, speed=2.0) as served:
            axis = served.open()
            motion = axis.start_move(90.0)
            served.emulator.faults.add(Fault("silent"))
            with pytest.raises(MotionFailed, match="nothing within") as caught:
                motion.wait()
            assert isinstance(caught.value.__cause__, ReplyTimeout)
            with pytest.raises(ReplyTimeout, match="power"):
                axis.read_position()
            served.emulator.faults.clear()
            served.emulator.clock.speed = FAST
            while served.emulator.axes[0].is_moving():
                time.sleep(0.01)
            assert axis.read_position().deg == pytest.approx(served.emulator.true_deg(0), abs=0.01)

    @pytest.mark.parametrize("fault", ["garbled", "late", "foreign", "silent"])
    def test_a_passing_fault_never_gives_a_wrong_position(self, kind: str, fault: str) -> None:
        """One spoiled reply, at every place of the exchange: the move ends right, or with an error."""
        right = 0
        with self.served(kind) as served:
            axis = served.open(reply_s=0.15)
            for place in range(1, 13) if fault == "garbled" else (1, 4, 7, 10):
                served.emulator.faults.add(Fault(fault, from_command=place, commands=1, amount=0.07))  # type: ignore[arg-type]
                target_deg = 7.0 * place
                try:
                    position = axis.start_move(target_deg).wait()
                except DeviceError:
                    patient_clock().sleep_s(0.1)
                    if not axis.is_homed():
                        break
                    continue
                finally:
                    served.emulator.faults.clear()
                right += 1
                assert position.deg == pytest.approx(target_deg, abs=0.05)
                assert position.deg == pytest.approx(served.emulator.true_deg(0), abs=1e-3)
        assert right >= 3

    @pytest.mark.parametrize("fault", ["garbled", "foreign"])
    def test_a_lasting_fault_ends_in_an_error(self, kind: str, fault: str) -> None:
        with self.served(kind) as served:
            axis = served.open(reply_s=0.1)
            served.emulator.faults.add(Fault(fault))  # type: ignore[arg-type]
            with pytest.raises((ReplyError, ReplyTimeout, MotionFailed)):
                axis.start_move(33.0).wait()

    def test_a_reset_in_mid_run_is_noticed(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open()
            axis.start_move(30.0).wait()
            served.emulator.faults.add(Fault("not_homed"))
            axis.read_position()
            with pytest.raises(NotHomedError):
                axis.start_move(40.0)
            assert served.emulator.true_deg(0) == pytest.approx(30.0, abs=0.05)

    def test_the_answer_to_a_stop_is_not_taken_for_that_of_the_next_question(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open()
            axis.start_move(30.0).wait()
            # Of the stop alone: the questions behind it are answered first.
            served.emulator.faults.add(Fault("late", commands=1, amount=0.1))
            axis.stop()
            assert not axis.is_moving()
            assert axis.is_homed()
            axis.check_fault()
            assert axis.read_position().deg == pytest.approx(30.0, abs=0.05)
            assert axis.start_move(31.0).wait().deg == pytest.approx(31.0, abs=0.05)
