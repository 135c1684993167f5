"""Requirements of every axis without faults: no motion without a command, right angles, limits, stop."""

import logging
import math
import threading
import time

import pytest

from drivers.errors import CommandRejected, LimitError, MotionStopped, NotHomedError
from simulators.conformance.served_axes import AxisTests


class AxisPromises(AxisTests):
    """Tests of an axis that works, on its emulator."""

    def test_opening_moves_nothing_and_tells_that_it_is_not_homed(self, kind: str) -> None:
        with self.served(kind, homed=False) as served:
            before = [axis.true_deg() for axis in served.emulator.axes]
            axis = served.open()
            assert not axis.may_move_on_connect
            assert not axis.is_homed()
            assert not axis.is_moving()
            with pytest.raises(NotHomedError, match="home the axis"):
                axis.start_move(10.0)
            time.sleep(0.02)
            assert [axis.true_deg() for axis in served.emulator.axes] == before
            assert all(axis.end_s() <= served.emulator.clock.now_s() for axis in served.emulator.axes)

    def test_identity_is_read_from_the_device(self, kind: str) -> None:
        with self.served(kind) as served:
            identity = served.open().describe()
            assert identity.kind == served.configs[0].kind  # type: ignore[attr-defined]
            assert identity.port == served.port.path
            assert identity.model
            assert identity.serial_number
            assert identity.firmware

    def test_homing_gives_a_reference_and_can_be_repeated(self, kind: str) -> None:
        with self.served(kind, homed=False) as served:
            axis = served.open()
            for _ in range(2):
                position = axis.home().wait()
                assert axis.is_homed()
                assert position.deg == pytest.approx(0.0, abs=0.01)
                assert served.emulator.true_deg(0) == pytest.approx(0.0, abs=0.01)
                axis.start_move(5.0).wait()
            axis.close()

    def test_moves_are_read_back_in_degrees_and_counts(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open()
            for target_deg in (9.0, -44.19, 372.5, 900.25, -0.01, 0.0):
                position = axis.start_move(target_deg).wait()
                assert position.deg == pytest.approx(target_deg, abs=axis.config.tolerance_deg)
                assert position.deg == pytest.approx(served.emulator.true_deg(0), abs=1e-3)
                assert position.deg == pytest.approx(position.counts / axis.counts_per_deg, abs=1e-9)
                assert axis.read_position() == position
                assert not axis.is_moving()

    @pytest.mark.parametrize(("zero_deg", "direction"), [(12.5, 1), (-3.25, -1)])
    def test_one_zero_and_one_direction(self, kind: str, zero_deg: float, direction: int) -> None:
        with self.served(kind) as served:
            axis = served.open(zero_deg=zero_deg, direction=direction, limits_deg=(-400.0, 500.0))
            assert axis.limits.min_deg == -400.0
            assert axis.limits.max_deg == 500.0
            position = axis.start_move(40.0).wait()
            assert position.deg == pytest.approx(40.0, abs=0.05)
            assert served.emulator.true_deg(0) == pytest.approx(direction * 40.0 + zero_deg, abs=0.05)

    def test_targets_outside_the_limits_are_refused_without_a_byte(self, kind: str) -> None:
        with self.served(kind) as served:
            axis = served.open(limits_deg=(-10.0, 20.0))
            before = served.emulator.faults.commands
            for target_deg in (20.5, -10.5, 1e9, math.nan, math.inf, -math.inf):
                with pytest.raises(LimitError, match="limits are -10 to 20 deg"):
                    axis.check(target_deg)
                with pytest.raises(LimitError):
                    axis.start_move(target_deg)
            axis.check(20.0)
            assert served.emulator.faults.commands == before
            assert axis.start_move(20.0).wait().deg == pytest.approx(20.0, abs=0.05)

    def test_limits_of_the_controller_count_as_well(self, kind: str) -> None:
        with self.served(kind, limits_deg=(0.0, 90.0)) as served:
            axis = served.open(zero_deg=10.0, direction=-1)
            if not served.emulator.tells_limits:
                assert (axis.limits.min_deg, axis.limits.max_deg) == (None, None)
                return
            assert axis.limits.min_deg == pytest.approx(-80.0, abs=0.001)
            assert axis.limits.max_deg == pytest.approx(10.0, abs=0.001)
            with pytest.raises(LimitError):
                axis.start_move(10.1)

    def test_two_moves_at_once_on_one_axis_are_refused(self, kind: str) -> None:
        # So slow that the axis does not arrive before the second move, even if this thread runs late.
        with self.served(kind, speed=0.1) as served:
            axis = served.open()
            motion = axis.start_move(60.0)
            assert not motion.done()
            with pytest.raises(CommandRejected, match="still moving"):
                axis.start_move(0.0)
            served.emulator.clock.speed = 1000.0
            assert motion.wait().deg == pytest.approx(60.0, abs=0.05)

    def test_stop_from_another_thread(self, kind: str, caplog: pytest.LogCaptureFixture) -> None:
        with self.served(kind, speed=1.0) as served:
            axis = served.open()
            # So far that the axis does not arrive before the stop, even if the thread runs late.
            far_deg = 900.0 if axis.can_stop_a_move else 120.0
            motion = axis.start_move(far_deg)

            def stop_on_the_way() -> None:
                while served.emulator.true_deg(0) < 5.0:
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

    def test_a_stop_in_mid_move_does_not_hide_that_the_axis_moves(self, kind: str) -> None:
        with self.served(kind, speed=1.0) as served:
            axis = served.open()
            axis.start_move(120.0)
            axis.stop()
            while axis.is_moving():
                time.sleep(0.002)
            assert not served.emulator.axes[0].is_moving()
            axis.check_fault()

    def test_deadlines_are_counted_by_the_clock_of_the_lines(self, kind: str) -> None:
        with self.served(kind) as served:
            assert served.open().clock is served.lines.clock
