"""Devices that answer unlike ours, through the commands of `acquire`: CR-only lines, no checksums; a filter wheel."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from processing.storage.captures.capture import Capture
from simulators.clock import FastClock
from simulators.rig.controller_kinds import served_kinds
from simulators.rig.rig import SimulatedRig
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.serve_options import ServeOptions
from tests.rig_files import change_yaml

Rig = Callable[..., Path]
Acquire = Callable[..., tuple[int, str, str]]


class CarriageReturnsOnly:
    """An emulator whose replies end with CR alone, as a public simulation of the ESP301 has them."""

    def __init__(self, emulator: Emulator) -> None:
        self._emulator = emulator
        self.receive, self.next_output_s = emulator.receive, emulator.next_output_s

    def take_output(self) -> bytes:
        return self._emulator.take_output().replace(b"\r\n", b"\r")


@pytest.mark.parametrize("kind", ["esp301", "zaber-no-checksums"])
def test_doctor_home_and_move_of_a_foreign_controller(acquire: Acquire, small_rig: Rig, kind: str) -> None:
    emulator = served_kinds()[kind](ServeOptions(clock=FastClock(100.0), limits_deg=(-180.0, 180.0)))
    served = CarriageReturnsOnly(emulator) if kind == "esp301" else emulator
    with PtyPort(served) as port:
        psg = {"kind": kind.partition("-")[0], "port": port.path}
        psg |= {"assume_homed": True} if kind == "esp301" else {"address": 1}
        axes = {
            "psg": psg,
            "psa": {"kind": "zaber", "port": "sim:rotators", "address": 2},
            "arm": {"kind": "smc100", "port": "sim:arm", "address": 1, "limits_deg": [0, 180]},
        }
        rig = small_rig(top={"axes": axes})
        code, out, err = acquire("doctor", "--rig", rig, "--frames", 2)
        assert code == 0, out + err
        assert port.path in out
        code, out, err = acquire("home", "psg", "--rig", rig, "--yes")
        assert code == 0, out + err
        code, out, err = acquire("move", "psg", 30, "--rig", rig)
        assert code == 0, out + err
        assert emulator.true_deg(0) == pytest.approx(30.0, abs=0.05)


def test_a_filter_wheel_chooses_the_wavelength_and_makes_the_darks(
    acquire: Acquire, small_rig: Rig, tmp_path: Path
) -> None:
    ports = {
        "rotators": {"kind": "zaber", "axes": 2},
        "arm": {"kind": "smc100", "axes": 1, "speed_deg_s": 40, "acceleration_deg_s2": 80},
        "wheel": {"kind": "fw102c"},
    }
    wheel = {"kind": "fw102c", "port": "sim:wheel", "positions": {451: 1, 662: 3}, "dark_position": 6}
    rig = small_rig(top={"source": wheel, "interlocks": []}, ports=ports)
    plan = tmp_path / "plan.yaml"
    plan.write_text("kind: plan\nmode: stokes\ndarks: 1\nexposure_s: 0.005\nstates: {kind: fixed, states: 1}\n")
    out = tmp_path / "captures"
    acquire.made("--rig", rig, "--plan", plan, "--sample", "air", "--omega", 180, "--out", out)
    with Capture(next(out.glob("*.h5"))) as capture:
        dark, light = (float(capture.frames(k).mean()) for k in (0, 1))
        assert light > 3 * dark
    code, _, err = acquire(
        "--rig", rig, "--plan", plan, "--sample", "air", "--omega", 180, "--wavelength", 524, "--out", out
    )
    assert code != 0
    assert "its filters are 451, 662 nm" in " ".join(err.split())


def test_a_whole_capture_on_a_camera_that_nobody_here_wrote(
    acquire: Acquire, small_rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = "arv-fake-gv-camera-0.8"
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed (Debian: aravis-tools); ./lab test installs it")
    # The other devices are ours; this camera stands at the address of our own.
    monkeypatch.setattr(SimulatedRig, "_start_camera", lambda self: None)
    settings = {"pixel_format": "Mono8", "width": 128, "height": 96}
    camera = {"kind": "aravis", "packet_size": 9000, "answers_early": True, "settings": settings}
    rig = change_yaml(small_rig(top={"camera": camera}), lambda tree: tree["detector"].update(bits=8))
    plan = tmp_path / "plan.yaml"
    # Its picture does not change with the light: darks would be as bright as the rest, and end the capture.
    plan.write_text("kind: plan\ndarks: 0\nexposure_s: 0.05\nstates: {kind: rotating_retarders, states: 20}\n")
    with subprocess.Popen([program, "-i", "127.0.0.1"]) as process:
        try:
            out = tmp_path / "captures"
            code, _, err = acquire("--rig", rig, "--plan", plan, "--out", out)
        finally:
            process.kill()
    assert code == 0, err
    with Capture(next(out.glob("*.h5"))) as capture:
        assert capture.status == "complete"
        assert capture.done.size == 20
        assert sorted(set(capture.column("frame_id"))) == list(capture.column("frame_id"))
        assert capture.closing["stream"]["stale_discarded"] == 0
