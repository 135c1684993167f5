"""Clients that CI does not install; each runs where `more_clients.txt` beside this file was installed as well."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from served_emulator import served, wait_until

pytestmark = [pytest.mark.third_party, pytest.mark.filterwarnings("ignore")]


@pytest.mark.parametrize("kind", ["zaber", "zaber-no-checksums"])
def test_zaber_serial(kind: str) -> None:
    zaber = pytest.importorskip("zaber.serial")
    with served(kind) as (emulator, path):
        line = zaber.AsciiSerial(path, 115200)
        try:
            stage = zaber.AsciiDevice(line, 1)
            stage.home()
            stage.move_abs(10_000)
            stage.move_rel(-500)
            assert stage.get_position() == 9500
            assert emulator.true_deg(0) == pytest.approx(9500 / 768_000 * 360)
            stage.move_vel(1000)
            stage.stop()
            assert stage.get_status() == "IDLE"
        finally:
            line.close()


def test_microscope_zaber() -> None:
    zaber = pytest.importorskip("microscope.controllers.zaber")
    with served("zaber") as (emulator, path):
        chain = zaber.ZaberDaisyChain(path, {1: zaber.ZaberDeviceType.STAGE})
        (stage,) = chain.devices.values()
        # It homes the axis and does not wait for it.
        stage.enable()
        wait_until("homed", lambda: emulator.axes[0].homed and not emulator.axes[0].is_moving())
        axis = stage.axes["1"]
        axis.move_to(5000)
        wait_until("target", lambda: axis.position == 5000)
        axis.move_by(-1500)
        wait_until("target", lambda: axis.position == 3500)
        assert emulator.true_deg(0) == pytest.approx(3500 / 768_000 * 360)
        assert axis.limits.lower < 0 < axis.limits.upper
        chain.shutdown()


def test_microscope_filter_wheel() -> None:
    thorlabs = pytest.importorskip("microscope.filterwheels.thorlabs")
    with served("fw102c") as (_, path):
        wheel = thorlabs.ThorlabsFilterWheel(com=path, timeout=5.0)
        assert wheel.n_positions == 6
        for position in (2, 5, 0):
            wheel.position = position
            assert wheel.position == position


def test_elliptec() -> None:
    elliptec = pytest.importorskip("elliptec")
    with served("elliptec") as (emulator, path), elliptec.Controller(path) as controller:
        rotator = elliptec.Rotator(controller)
        rotator.home()
        for angle_deg in (45.0, -30.0):
            rotator.set_angle(angle_deg)
            assert rotator.get_angle() == pytest.approx(angle_deg, abs=0.01)
            assert emulator.true_deg(0) == pytest.approx(angle_deg, abs=0.01)


def test_thorlabs_elliptec() -> None:
    package = pytest.importorskip("thorlabs_elliptec")
    with served("elliptec") as (emulator, path):
        mount = package.ELLx(path)
        try:
            mount.home(blocking=True)
            for angle_deg in (30.0, -20.0):
                mount.move_absolute(angle_deg, blocking=True)
                assert mount.get_position() == pytest.approx(angle_deg, abs=0.01)
                assert emulator.true_deg(0) == pytest.approx(angle_deg, abs=0.01)
        finally:
            mount.close()


def test_tl_elliptec() -> None:
    package = pytest.importorskip("tl_elliptec")
    with served("elliptec") as (emulator, path), package.ElliptecBus(path) as bus:
        mounts = package.discover_devices(bus, addresses="012")
        assert {address: type(mount).__name__ for address, mount in mounts.items()}.items() >= {("0", "ELL14")}
        mount = mounts["0"]
        mount.home()
        assert mount.move_absolute(60.0) == pytest.approx(60.0, abs=0.01)
        assert emulator.true_deg(0) == pytest.approx(60.0, abs=0.01)


def test_elliptec_motorized_stages() -> None:
    bus_of = pytest.importorskip("ElliptecBus")
    stages = pytest.importorskip("ElliptecRotaryStages.ELL14")
    with served("elliptec") as (emulator, path), bus_of.ElliptecBus(path) as bus:
        assert bus.scan_addresses() == ["0", "1"]
        mounts = [stages.Ell14(bus, address) for address in ("0", "1")]
        for mount in mounts:
            mount.home()
        assert mounts[0].move_absolute_degrees(45.0) == pytest.approx(45.0, abs=0.01)
        assert mounts[1].move_relative_degrees(-30.0) == pytest.approx(-30.0, abs=0.01)
        assert (emulator.true_deg(0), emulator.true_deg(1)) == pytest.approx((45.0, -30.0), abs=0.01)
        mounts[0].set_velocity_percent(60)
        assert mounts[0].get_velocity_percent() == 60


def test_thorlabs_apt_protocol() -> None:
    protocol = pytest.importorskip("thorlabs_apt_protocol")
    with served("apt-k10cr2", homed=True) as (emulator, path), serial.Serial(path, 115200, timeout=0.05) as port:
        messages = protocol.Unpacker(port)

        def answer(name: str) -> Any:
            give_up_s = time.monotonic() + 8
            while time.monotonic() < give_up_s:
                for message in messages:
                    if message.msg == name:
                        return message
            return pytest.fail(f"no {name}")

        port.write(protocol.hw_req_info(dest=0x50, source=1))
        assert answer("hw_get_info").model_number == b"K10CR2\0\0"
        port.write(protocol.mot_move_absolute(dest=0x50, source=1, chan_ident=1, position=1_365_333))
        answer("mot_move_completed")
        assert emulator.true_deg(0) == pytest.approx(10.0, abs=1e-4)
        port.write(protocol.mot_req_poscounter(dest=0x50, source=1, chan_ident=1))
        assert answer("mot_get_poscounter").position == 1_365_333


@contextmanager
def daemon(command: str, folder: Path, path: str, **more: object) -> Iterator[Any]:
    """A daemon of the yaq family as it stands, and its client."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    entries = {"port": port, "serial_port": path, **more}
    lines = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in entries.items()]
    config = folder / "config.toml"
    config.write_text("[axis]\n" + "\n".join(lines) + "\n")
    # It keeps its state where XDG says.
    environment = os.environ | {"XDG_DATA_HOME": str(folder)}
    running = subprocess.Popen([Path(sys.executable).parent / command, "--config", config], env=environment)
    try:
        client = None
        give_up_s = time.monotonic() + 20
        while client is None:
            try:
                client = pytest.importorskip("yaqc").Client(port)
            except OSError:
                assert time.monotonic() < give_up_s
                time.sleep(0.1)
        yield client
    finally:
        running.terminate()
        running.wait()


@pytest.mark.parametrize(
    ("package", "command", "kind", "more"),
    [
        ("yaqd_thorlabs", "yaqd-thorlabs-ell18", "elliptec", {"scalar": 143360 / 360}),
        ("yaqd_newport", "yaqd-newport-smc100", "smc100", {"units": "deg"}),
    ],
)
def test_yaq_daemons(package: str, command: str, kind: str, more: dict[str, object], tmp_path: Path) -> None:
    pytest.importorskip(package)
    with served(kind) as (emulator, path), daemon(command, tmp_path, path, **more) as axis:
        # It homes the axis when it starts, after a reset of five seconds.
        wait_until("homed", lambda: emulator.axes[0].homed and not axis.busy(), 30)
        for target in (75.0, 30.0):
            axis.set_position(target)
            wait_until("target", lambda target=target: abs(axis.get_position() - target) < 0.02, 30)
            assert emulator.true_deg(0) == pytest.approx(target, abs=0.02)


def test_newport_library_of_the_xps() -> None:
    package = pytest.importorskip("newportxps.XPS_C8_drivers")
    with served("xps") as (emulator, path):
        host, port = path.removeprefix("socket://").split(":")
        xps = package.XPS()
        line = xps.TCP_ConnectToServer(host, int(port), 20)
        assert line >= 0
        assert xps.Login(line, "Administrator", "Administrator")[0] == 0
        assert xps.ObjectsListGet(line)[1].split(";;")[0].split(";") == ["Group1", "Group2"]
        assert xps.GroupHomeSearch(line, "Group1")[0] == -22
        assert xps.GroupInitialize(line, "Group1")[0] == 0
        assert xps.GroupHomeSearch(line, "Group1")[0] == 0
        assert xps.GroupStatusGet(line, "Group1") == [0, 11]
        assert xps.GroupMoveAbsolute(line, "Group1", [33.25])[0] == 0
        assert xps.GroupMoveRelative(line, "Group1", [-40.0])[0] == 0
        assert xps.GroupPositionCurrentGet(line, "Group1", 1) == [0, pytest.approx(-6.75)]
        assert xps.GroupVelocityCurrentGet(line, "Group1", 1) == [0, 0.0]
        assert emulator.true_deg(0) == pytest.approx(-6.75)
        error, low, high = xps.PositionerUserTravelLimitsGet(line, "Group1.Pos")
        assert (error, low < 0 < high) == (0, True)
        assert xps.PositionerPositionCompareSet(line, "Group1.Pos", 0, 10, 0.5)[0] == 0
        assert xps.PositionerPositionCompareGet(line, "Group1.Pos")[:4] == [0, 0.0, 10.0, 0.5]
        assert xps.GatheringConfigurationSet(line, ["Group1.Pos.CurrentPosition"])[0] == 0
        assert xps.GatheringRun(line, 100, 8)[0] == 0
        assert xps.GroupJogModeEnable(line, "Group1")[0] == 0
        assert xps.GroupJogParametersSet(line, "Group1", [20.0], [100.0])[0] == 0
        wait_until("jog", lambda: emulator.true_deg(0) > 0.0)
        assert xps.GroupJogParametersSet(line, "Group1", [0.0], [100.0])[0] == 0
        wait_until("rest", lambda: xps.GroupJogModeDisable(line, "Group1")[0] == 0)
        assert xps.GatheringCurrentNumberGet(line)[:2] == [0, 100]
        positions = [float(text) for text in xps.GatheringDataMultipleLinesGet(line, 0, 100)[1].split()]
        assert positions[0] == pytest.approx(-6.75, abs=0.01)
        assert positions == sorted(positions)
        xps.TCP_CloseSocket(line)


def test_pipython() -> None:
    package = pytest.importorskip("pipython")
    with served("gcs2") as (emulator, path):
        # Through a port of Python's, in place of PI's library in C.
        serial = pytest.importorskip("pipython.pidevice.interfaces.piserial")
        gateway = serial.PISerial(path, 115200)
        controller = package.GCSDevice(gateway=gateway)
        try:
            assert "0115012345" in controller.qIDN()
            axis = controller.axes[0]
            controller.SVO(axis, True)
            with pytest.raises(package.GCSError):
                controller.MOV(axis, 10.0)
            controller.FRF(axis)
            wait_until("referenced", lambda: controller.qFRF(axis)[axis] and not controller.IsMoving(axis)[axis])
            controller.MOV(axis, 10.0)
            wait_until("target", lambda: controller.qONT(axis)[axis])
            controller.MVR(axis, -25.0)
            wait_until("target", lambda: controller.qONT(axis)[axis])
            assert controller.qPOS(axis)[axis] == pytest.approx(-15.0, abs=1e-3)
            assert emulator.true_deg(0) == pytest.approx(-15.0, abs=1e-3)
            controller.StopAll(noraise=True)
        finally:
            gateway.close()


def test_pysigmakoki() -> None:
    package = pytest.importorskip("sigma_koki")
    with served("gsc-02") as (emulator, path):
        box = package.GSC02()
        box.open(path)
        try:
            box.returnToMechanicalOrigin("-", "-")
            box.waitForReady(10)
            assert [axis.homed for axis in emulator.axes] == [True, True]
            box.setSpeed(True, 100, 5000, 200, 100, 5000, 200)
            box.move(4000, -2000)
            box.waitForReady(10)
            box.move_relative(-400, 400)
            box.waitForReady(10)
            assert (emulator.true_deg(0), emulator.true_deg(1)) == (9.0, -4.0)
            assert box.getVersion() == "V1.10"
            box.jog("+", "")
            wait_until("jog", lambda: emulator.true_deg(0) > 9.0)
            box.stop()
            wait_until("rest", lambda: not emulator.axes[0].is_moving())
        finally:
            box.close()


def test_pyoptosigma() -> None:
    package = pytest.importorskip("pyOptoSigma")
    with served("gsc-01") as (emulator, path):
        session = package.Session(package.Controllers.SHOT_302GS, wait_time=0.05)
        session.append_stage(package.Stages.SGSP_60YAW)
        session.connect(path)
        try:
            session.reset(1, mechanical=True, wait_for_finish=True)
            assert emulator.axes[0].homed
            # In thousandths of a degree.
            session.move(stage=1, amount=10_000, absolute=True)
            session.move(stage=1, amount=-2000)
            assert emulator.true_deg(0) == 8.0
            session.set_speed(1, 100, 4000, 200)
            session.jog(1, 1)
            wait_until("jog", lambda: emulator.true_deg(0) > 8.0)
            session.stop(1)
            wait_until("rest", lambda: not session.is_busy())
        finally:
            session.port.close()


def test_plico_motor_server() -> None:
    filters = pytest.importorskip("plico_motor_server.devices.KURIOSVB1_thorlabs")
    with served("kurios") as (emulator, path):
        head = filters.TunableFilter("filter", SimpleNamespace(port_name=lambda: path), 115_200)
        assert "KURIOS-VB1" in head.connect()
        try:
            head.move_to(1, 662)
            assert emulator.values["WL"] == 662.0
            assert "TP=31.200" in head.get_temperature()
        finally:
            head.disconnect()


def test_pymodaq_smc100() -> None:
    package = pytest.importorskip("pymodaq_plugins_newport.hardware.smc100")
    with served("smc100") as (emulator, path):
        arm = package.SMC100(path)
        try:
            assert (arm.idn, arm.error_and_controller_status()) == ("URS150CC", ("0000", "0A"))
            arm.homing()
            wait_until("homed", lambda: emulator.axes[0].homed)
            arm.move_abs(30)
            arm.wait_move_finish(0.05)
            arm.move_rel(-5)
            arm.wait_move_finish(0.05)
            assert (arm.position, emulator.true_deg(0)) == (25.0, 25.0)
            arm.speed = 100
            assert (arm.speed, arm.get_last_command_error()) == (100.0, "@")
        finally:
            arm.close()


def test_instrumentkit_esp301() -> None:
    package = pytest.importorskip("instruments")
    with served("esp301") as (emulator, path):
        box = package.newport.NewportESP301.open_serial(path, 19_200, timeout=1)
        axis = box.axis[0]
        axis.enable()
        axis.search_for_home()
        wait_until("homed", lambda: axis.is_motion_done)
        axis.move(20, absolute=True)
        wait_until("target", lambda: axis.is_motion_done)
        axis.move(-5, absolute=False)
        wait_until("target", lambda: axis.is_motion_done)
        assert axis.position.magnitude == emulator.true_deg(0) == 15.0
        assert axis.right_limit.magnitude == 180.0


def test_instrumentkit_lcc25() -> None:
    package = pytest.importorskip("instruments")
    with served("lcc25") as (emulator, path):
        box = package.thorlabs.LCC25.open_serial(path, 115_200, timeout=1)
        assert "LCC25" in box.name
        box.mode = box.Mode.voltage1
        box.voltage1 = 1.5
        assert emulator.true_deg() == 0.0
        box.enable = True
        wait_until("voltage", lambda: emulator.true_deg() == 1.5)
        box.voltage2 = 4.0
        box.mode = box.Mode.voltage2
        assert (box.voltage1.magnitude, box.voltage2.magnitude, box.enable) == (1.5, 4.0, True)
        wait_until("voltage", lambda: emulator.true_deg() == 4.0)
        box.frequency = 60
        assert box.frequency.magnitude == 60.0


def test_oriel_cornerstone() -> None:
    package = pytest.importorskip("oriel_cornerstone_260.monochromator")
    with served("cornerstone") as (emulator, path):
        instrument = package.Monochromator(path)
        assert "Cornerstone 260" in instrument.info
        assert instrument.goto(662.0) == emulator.wavelength_nm == 662.0
        assert instrument.shuttered
        instrument.shutter(close=False)
        assert (instrument.shuttered, emulator.light_at(662.0)) == (False, 1.0)
        instrument.set_grating(2)
        assert instrument.grating == {"number": 2, "lines": 1200, "label": "VIS"}
        assert instrument.slit_width(1, 250) == 250


def test_instrumentkit_sc10() -> None:
    package = pytest.importorskip("instruments")
    with served("sc10") as (emulator, path):
        box = package.thorlabs.SC10.open_serial(path, 9600, timeout=1)
        assert (box.enable, box.closed, box.interlock) == (False, True, False)
        box.mode = box.Mode.manual
        box.enable = True
        wait_until("blade", lambda: emulator.is_open())
        box.open_time, box.repeat = 500, 3
        assert (box.closed, box.open_time.magnitude, box.repeat, box.baud_rate) == (False, 500, 3, 9600)
