"""Ports: permission, TCP, transcripts, one owner for each line, emulators that outlive their clients."""

import errno
import os
import pty
import select
import socket
import subprocess
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import serial

from drivers.axes import smc100, zaber
from drivers.errors import PermissionRefused, PortBusy, PortNotFound
from drivers.registry import device_kinds, open_axis
from drivers.serial_link import LineRegistry, SerialLink, line_framer
from simulators.clock import FastClock, patient_clock
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.serve_options import ServeOptions


def zaber_emulator(**options: object):  # type: ignore[no-untyped-def]
    return served_kinds()["zaber"](ServeOptions(homed=True, clock=FastClock(100.0, base=patient_clock()), **options))  # type: ignore[arg-type]


def test_no_permission_names_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    port = tmp_path / "ttyS9"
    port.touch()

    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "denied")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(PermissionRefused, match=r"belongs to group \w+.*log in again"):
        SerialLink(str(port), 9600, line_framer)


def test_a_file_that_is_no_port(tmp_path: Path) -> None:
    plain = tmp_path / "notes.txt"
    plain.write_text("not a port")
    with pytest.raises(PortNotFound):
        SerialLink(str(plain), 9600, line_framer)
    with pytest.raises(PortNotFound):
        SerialLink("socket://127.0.0.1:1", 9600, line_framer)


def test_a_write_waits_quietly_while_the_device_holds_the_line() -> None:
    """A controller, or noise that looks like its XOFF, holds the line until XON."""
    device, port = pty.openpty()
    tty.setraw(port)
    link = SerialLink(os.ttyname(port), 57_600, line_framer, xonxoff=True)
    spent_s: list[float] = []

    def write() -> None:
        link.write(b"1TS\r\n")
        spent_s.append(time.thread_time())

    os.write(device, b"\x13")
    while select.select([], [port], [], 0)[1]:
        time.sleep(0.001)
    writer = threading.Thread(target=write)
    writer.start()
    time.sleep(1.0)
    assert not spent_s
    os.write(device, b"\x11")
    writer.join()
    assert os.read(device, 100) == b"1TS\r\n"
    # Trying again and again takes as much of a second as the machine has to give.
    assert spent_s[0] < 0.05
    link.close()
    os.close(device)
    os.close(port)


@contextmanager
def behind_tcp(emulator: Emulator, line_end: bytes = b"\r\n") -> Iterator[str]:
    """Serve one client over TCP, with replies that end as said; gives the port to write into a rig file."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = server.accept()
        # A client that leaves while a reply is sent is gone.
        with connection, suppress(ConnectionError):
            connection.settimeout(0.002)
            while True:
                try:
                    data = connection.recv(4096)
                    if not data:
                        return
                    emulator.receive(data)
                except TimeoutError:
                    pass
                connection.sendall(emulator.take_output().replace(b"\r\n", line_end))

    thread = threading.Thread(target=serve)
    thread.start()
    yield f"socket://127.0.0.1:{server.getsockname()[1]}"
    thread.join()
    server.close()


@pytest.mark.parametrize("line_end", [b"\r\n", b"\r", b"\n"])
@pytest.mark.parametrize("kind", ["zaber", "esp301", "smc100"])
def test_an_axis_behind_tcp(kind: str, line_end: bytes) -> None:
    emulator = served_kinds()[kind](ServeOptions(homed=True, clock=FastClock(100.0, base=patient_clock())))
    with behind_tcp(emulator, line_end) as port, LineRegistry(clock=patient_clock()) as lines:
        axis = open_axis("psg", axis_configs(emulator, port, homed=True)[0], lines)
        assert axis.start_move(45.0).wait().deg == pytest.approx(45.0, abs=0.01)
        axis.close()


def test_the_simulator_behind_a_pseudo_terminal_may_be_named_as_its_holder() -> None:
    # A simulator that keeps both ends of its pseudo-terminal open, as socat does.
    with PtyPort(zaber_emulator()) as port:
        with open(port.path, "r+b", buffering=0) as other_end:
            holder = subprocess.Popen(["sleep", "30"], stdin=other_end)
        try:
            with pytest.raises(PortBusy, match=r"sleep \(pid \d+\).*write its name as `held_by`"):
                SerialLink(port.path, 9600, line_framer)
            with pytest.raises(PortBusy, match="sleep"):
                SerialLink(port.path, 9600, line_framer, held_by="cat")
            with LineRegistry(clock=patient_clock()) as lines:
                config = zaber.Config(port=port.path, address=1, held_by="sleep")
                assert open_axis("psg", config, lines).start_move(20.0).wait().deg == pytest.approx(20.0, abs=0.01)
        finally:
            holder.kill()
            holder.wait()


def test_a_link_by_another_name_is_the_same_line(tmp_path: Path) -> None:
    with PtyPort(zaber_emulator()) as port, LineRegistry(clock=patient_clock()) as lines:
        link = tmp_path / "usb-Zaber_by_id"
        link.symlink_to(port.path)
        first = open_axis("psg", zaber.Config(port=str(link), address=1), lines)
        second = open_axis("psa", zaber.Config(port=port.path, address=2), lines)
        with pytest.raises(PortBusy, match="ZaberLine"):
            open_axis("arm", smc100.Config(port=port.path), lines)
        first.close()
        first.close()
        assert not second.is_moving()


def test_the_transcript_holds_every_byte(tmp_path: Path) -> None:
    with PtyPort(zaber_emulator()) as port, LineRegistry(tmp_path / "wire", patient_clock()) as lines:
        axis = open_axis("psg", zaber.Config(port=port.path, address=1), lines)
        axis.read_position()
        axis.close()
    (log,) = (tmp_path / "wire").iterdir()
    lines_of_log = log.read_text().splitlines()
    assert any(">> /1 1 " in line and "get pos" in line for line in lines_of_log)
    assert any("<<" in line and "OK IDLE -- 0:" in line for line in lines_of_log)


def test_an_emulator_outlives_its_clients() -> None:
    with PtyPort(zaber_emulator()) as port:
        for turn in range(3):
            with LineRegistry(clock=patient_clock()) as lines:
                axis = open_axis("psg", axis_configs(port.emulator, port.path)[0], lines)  # type: ignore[arg-type]
                assert axis.read_position().deg == pytest.approx(10.0 * turn, abs=0.01)
                axis.start_move(10.0 * (turn + 1)).wait()


def test_a_failing_emulator_is_not_silent() -> None:
    emulator = zaber_emulator()
    emulator.devices[0].serial_number = None
    emulator.devices[0].run = None
    port = PtyPort(emulator)
    with serial.Serial(port.path, timeout=0.5) as client:
        client.write(b"/1 get pos\n")
        client.read(1)
    with pytest.raises(RuntimeError, match="emulator"):
        port.close()


def test_kinds_are_found_by_folder() -> None:
    assert {"zaber", "elliptec", "smc100", "apt", "esp301"} <= set(device_kinds("axes"))
    for kind, module in device_kinds("axes").items():
        assert module.Config.model_fields["kind"].default == kind
        assert module.__doc__


def test_unknown_entries_of_a_rig_file_are_refused() -> None:
    with pytest.raises(ValueError, match="sped"):
        zaber.Config.model_validate({"kind": "zaber", "port": "x", "sped": 3})
    with pytest.raises(ValueError, match="direction"):
        zaber.Config.model_validate({"kind": "zaber", "port": "x", "direction": 0})
