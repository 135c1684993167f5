"""Clients that nobody here wrote must be able to drive the emulators; what had to be mended is in docs."""

import re
import sys
import time
from types import ModuleType
from unittest.mock import MagicMock

import pytest
from served_emulator import served, wait_until

# The warnings that these packages cause are theirs, not ours.
pytestmark = [pytest.mark.third_party, pytest.mark.filterwarnings("ignore")]


def test_zaber_motion() -> None:
    from zaber_motion.ascii import Connection
    from zaber_motion.exceptions.bad_data_exception import BadDataException

    with served("zaber") as (emulator, path), Connection.open_serial_port(path) as connection:
        connection.enable_alerts()
        devices = connection.detect_devices(identify_devices=False)
        assert [device.device_address for device in devices] == [1, 2, 3]
        axis = devices[0].get_axis(1)
        assert axis.warnings.get_flags() == {"WR"}
        axis.home()
        axis.move_absolute(10_000)
        axis.move_relative(-500)
        assert axis.get_position() == 9500
        assert emulator.true_deg(0) == pytest.approx(9500 / 768_000 * 360)
        axis.move_velocity(1000)
        axis.stop()
        assert not axis.is_busy()
        arm = devices[2].get_axis(1)
        arm.home()
        with pytest.raises(BadDataException):
            arm.move_absolute(10**8)


def test_pylablib_elliptec(monkeypatch: pytest.MonkeyPatch) -> None:
    from pylablib.devices import Thorlabs

    # It looks for modules for half a second of real time, which a busy machine may take for one answer.
    monkeypatch.setattr(Thorlabs.ElliptecMotor._detect_devices, "__defaults__", ("all", 10.0, 0.1))
    with served("elliptec") as (emulator, path):
        motor = Thorlabs.ElliptecMotor(path, addrs=[0, 1], scale="stage")
        try:
            assert motor.get_device_info().model_no == 14
            motor.home()
            motor.home(addr=1)
            motor.move_to(90)
            motor.move_by(-110)
            assert motor.get_position() == pytest.approx(-20, abs=0.01)
            assert emulator.true_deg(0) == pytest.approx(-20, abs=0.01)
            motor.move_to(10, addr=1)
            assert emulator.true_deg(1) == pytest.approx(10, abs=0.01)
        finally:
            motor.close()


def test_pylablib_standa() -> None:
    from pylablib.devices import Standa

    with served("standa") as (emulator, path):
        stage = Standa.Standa8SMC(path)
        try:
            assert stage.get_engine_type().engine == "step"
            stage.home()
            assert stage.set_position_reference(0) == 0
            # In microsteps, of which a step has 256 and a degree 100 steps.
            stage.move_to(256_000)
            stage.wait_move()
            stage.move_by(-128_000)
            stage.wait_move()
            assert stage.get_position() == 128_000
            assert emulator.true_deg(0) == pytest.approx(5.0)
            stage.jog("+")
            wait_until("jog", lambda: emulator.true_deg(0) > 6.0)
            stage.stop()
            stage.wait_move()
            stage.setup_power(hold_current=33)
            assert stage.get_power_parameters().hold_current == 33
        finally:
            stage.close()


def test_pylablib_filter_wheel() -> None:
    from pylablib.devices import Thorlabs

    with served("fw102c") as (emulator, path):
        wheel = Thorlabs.FW(path)
        try:
            assert (wheel.get_pcount(), wheel.get_position()) == (6, 6)
            wheel.set_position(3)
            wait_until("filter", lambda: emulator.light_at(662.0) == 1.0)
            assert wheel.get_position() == 3
        finally:
            wheel.close()


@pytest.mark.parametrize(
    ("kind", "scale"),
    [
        ("apt-k10cr1", "K10CR1"),
        ("apt-k10cr2", (409600 / 3, 7329109.0, 1502.0)),
        ("apt-kdc101", "stage"),
        ("apt-kbd101", "DDR25"),
        ("apt-kst101", "NR360"),
        ("apt-bsc203", "NR360"),
        ("apt-bbd203", "DDR100"),
    ],
)
def test_pylablib_kinesis(kind: str, scale: object, monkeypatch: pytest.MonkeyPatch) -> None:
    from pylablib.devices import Thorlabs
    from pylablib.devices.Thorlabs import kinesis

    # It toggles RTS, which a pseudo-terminal does not have.
    monkeypatch.setattr(kinesis.BasicKinesisDevice, "_cycle_rts", staticmethod(lambda instr: None))
    with served(kind) as (emulator, path):
        rack = kind in ("apt-bsc203", "apt-bbd203")
        motor = Thorlabs.KinesisMotor(("serial", path), scale=scale, is_rack_system=rack)
        try:
            assert motor.get_scale_units() == ("user" if isinstance(scale, tuple) else "deg")
            motor.home()
            motor.wait_for_home()
            assert motor.is_homed()
            motor.move_to(30)
            motor.wait_move()
            motor.move_by(-50)
            motor.wait_move()
            assert motor.get_position() == pytest.approx(-20, abs=0.01)
            assert emulator.true_deg(0) == pytest.approx(-20, abs=0.01)
            serial_number = motor.get_full_info()["device_info"].serial_no
            assert emulator.model.serial_number == serial_number
        finally:
            motor.close()


def test_thorlabs_apt_device() -> None:
    from thorlabs_apt_device import KDC101

    with served("apt-kdc101") as (emulator, path):
        unit = KDC101(serial_port=path, home=False)
        try:
            wait_until("first status", lambda: unit.status["msg"] != "")
            unit.home()
            wait_until("homed", lambda: unit.status["homed"] and not unit.status["homing"])
            unit.move_absolute(19_196)
            wait_until("target", lambda: unit.status["position"] == 19_196)
            unit.move_relative(-30_000)
            wait_until("target", lambda: unit.status["position"] == -10_804)
            assert emulator.true_deg(0) == pytest.approx(-10_804 / 1919.6418578623391)
        finally:
            unit.close()
            time.sleep(0.3)


def test_thorlabs_apt_device_and_the_bays_of_a_rack() -> None:
    from thorlabs_apt_device.devices.bsc import BSC

    with served("apt-bsc203", speed=4.0, axes=3) as (emulator, path):
        rack = BSC(serial_port=path, home=False, x=3)
        try:
            for bay in (1, 2):
                status = rack.status_[bay][0]
                wait_until("first status", lambda status=status: status["msg"] != "")
                rack.home(bay=bay)
                wait_until("homed", lambda status=status: status["homed"] and not status["homing"])
                rack.move_absolute(bay * 20_000, bay=bay)
                wait_until("target", lambda status=status, bay=bay: status["position"] == bay * 20_000)
            assert [emulator.true_deg(bay) * emulator.model.per_deg for bay in (1, 2)] == pytest.approx([2e4, 4e4])
            assert not emulator.axes[0].homed
        finally:
            rack.close()
            time.sleep(0.3)


def test_qmi_k10cr1(monkeypatch: pytest.MonkeyPatch) -> None:
    from qmi.core.context import QMI_Context
    from qmi.instruments.thorlabs import Thorlabs_K10Cr1

    # It waits this long in every query, whenever the reply comes.
    monkeypatch.setattr(Thorlabs_K10Cr1, "RESPONSE_TIMEOUT", 0.2)
    with served("apt-k10cr1") as (emulator, path):
        context = MagicMock(spec=QMI_Context)
        context.name = "test"
        mount = Thorlabs_K10Cr1(context, "mount", f"serial:{path}")
        mount.open()
        try:
            assert mount.get_idn().serial == 55_000_001
            assert not mount.get_motor_status().homed
            mount.move_home()
            mount.wait_move_complete(5)
            mount.move_absolute(33)
            mount.wait_move_complete(5)
            assert mount.get_absolute_position() == pytest.approx(33, abs=1e-4)
            assert emulator.true_deg(0) == pytest.approx(33, abs=1e-4)
        finally:
            mount.close()


def test_qmi_smc100(monkeypatch: pytest.MonkeyPatch) -> None:
    from qmi.core.context import QMI_Context
    from qmi.instruments.newport.actuators import LinearActuator
    from qmi.instruments.newport.smc_100cc import Newport_SMC100CC

    # It sleeps half a second around each command; the emulator needs less.
    monkeypatch.setattr(Newport_SMC100CC, "COMMAND_EXEC_TIME", 0.02)
    with served("smc100") as (emulator, path):
        context = MagicMock(spec=QMI_Context)
        context.name = "test"
        stage = LinearActuator(0, 180, 300, 0.001, 0.001, 1, 0.001)
        arm = Newport_SMC100CC(context, "arm", f"serial:{path}", "serial", {1: stage}, 57600)
        arm.open()
        try:
            assert arm.get_idn().model == "SMC100CC"
            assert arm.get_positioner_error_and_state() == ([], "NOT REFERENCED from RESET")
            arm.home_search()
            wait_until("homed", lambda: "READY" in arm.get_positioner_error_and_state()[1])
            arm.move_absolute(45.5)
            wait_until("target", lambda: "READY from MOVING" in arm.get_positioner_error_and_state()[1])
            assert arm.get_position() == 45.5
            assert emulator.true_deg(0) == 45.5
            assert arm.get_error() == ("@", "No error")
        finally:
            arm.close()


def test_pymeasure_esp300() -> None:
    from pymeasure.adapters import SerialAdapter
    from pymeasure.instruments.newport import ESP300

    with served("esp301") as (emulator, path):
        adapter = SerialAdapter(path, baudrate=19200, timeout=1, write_termination="\r", read_termination="\r\n")
        controller = ESP300(adapter)
        try:
            assert controller.errors == []
            assert controller.x.units == "degree"
            assert controller.x.right_limit >= 90
            controller.x.position = 10
            assert [str(error).split(": ")[1] for error in controller.errors] == ["MOTOR NOT ENABLED"]
            controller.x.enable()
            controller.x.home()
            controller.x.wait_for_stop()
            controller.x.position = -45
            controller.x.wait_for_stop()
            assert controller.x.position == -45
            assert emulator.true_deg(0) == -45
            controller.x.position = 400
            assert "POSITIVE SOFTWARE LIMIT" in str(controller.errors[0])
        finally:
            adapter.close()


def test_libximc(monkeypatch: pytest.MonkeyPatch) -> None:
    # It asks for a module of Windows, whatever the system.
    monkeypatch.setitem(sys.modules, "winreg", ModuleType("winreg"))
    import libximc.highlevel as ximc

    with served("standa") as (emulator, path):
        stage = ximc.Axis(f"xi-com://{path}")
        stage.open_device()
        try:
            assert stage.get_serial_number() == 27_182
            assert not stage.get_status().Flags & ximc.StateFlags.STATE_IS_HOMED
            stage.command_homezero()
            assert stage.get_status().Flags & ximc.StateFlags.STATE_IS_HOMED
            assert emulator.true_deg(0) == pytest.approx(0.0, abs=1e-9)
            stage.command_move(-1234, -56)
            stage.command_wait_for_stop(10)
            position = stage.get_position()
            assert (position.Position, position.uPosition) == (-1234, -56)
            assert emulator.true_deg(0) == pytest.approx(-(1234 + 56 / 256) / 100, abs=1e-9)
            settings = stage.get_move_settings()
            settings.Speed = 500
            stage.set_move_settings(settings)
            stage.command_movr(100_000, 0)
            wait_until("motion", lambda: emulator.true_deg(0) > -12.0)
            stage.command_sstp()
            stage.command_wait_for_stop(10)
            assert emulator.true_deg(0) < 500.0
            for turn, sign in ((stage.command_left, -1), (stage.command_right, 1)):
                here_deg = emulator.true_deg(0)
                turn()
                wait_until("motion", lambda sign=sign, here_deg=here_deg: sign * (emulator.true_deg(0) - here_deg) > 1)
                stage.command_stop()
                stage.command_wait_for_stop(10)
            stage.set_position(ximc.set_position_t(500, 64, 0, ximc.PositionFlags.SETPOS_IGNORE_ENCODER))
            assert stage.get_position().Position == 500
            stage.command_loft()
            stage.command_power_off()
            # Every setting is kept.
            names = [name for name in dir(stage) if re.fullmatch(r"get_\w+_settings|get_controller_name", name)]
            assert len(names) >= 15
            for name in names:
                value = getattr(stage, name)()
                getattr(stage, f"set_{name[4:]}")(value)
            power = stage.get_power_settings()
            power.HoldCurrent = 42
            stage.set_power_settings(power)
            assert stage.get_power_settings().HoldCurrent == 42
            stage.command_save_settings()
            stage.command_read_settings()
        finally:
            stage.close_device()
