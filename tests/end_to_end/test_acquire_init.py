"""`acquire init` writes a rig file that loads, of what is there."""

import pytest

from acquisition.commands import init
from acquisition.commands.init import FoundPort, rig_text
from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from processing.errors import ProcessError

CAMERA = {"id": "x", "vendor": "Allied", "model": "Manta", "serial_number": "50-01", "address": "10.0.0.5"}
PORTS = [
    FoundPort("/dev/serial/by-id/usb-FTDI_A", "FT230X, USB 0403:6015", "elliptec"),
    FoundPort("/dev/ttyUSB7", "something, USB 0403:6001", None),
    FoundPort("/dev/serial/by-id/usb-Standa", "8SMC5, USB 1cbe:0007", "standa"),
    FoundPort("/dev/ttyACM0", "DC2200, USB 1313:80c8", "dc2200"),
]


def test_what_was_found_is_in_the_file_and_the_file_loads(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(rig_text("mine", [CAMERA, CAMERA | {"serial_number": "50-02"}], PORTS))
    rig = load_rig(path)
    assert (rig.name, rig.camera.device) == ("mine", "50-01")
    text = path.read_text()
    assert "#  NAME: {kind: elliptec, port: /dev/serial/by-id/usb-FTDI_A}" in text
    assert "#  NAME: {kind: KIND, port: /dev/ttyUSB7}" in text
    assert "#  NAME: {kind: standa, port: /dev/serial/by-id/usb-Standa, steps_per_deg: ...}" in text
    assert "# source: {kind: dc2200, port: /dev/ttyACM0}" in text
    assert "50-02" in text


def test_a_camera_of_the_network_is_found_and_nothing_is_replaced(small_rig, acquire, tmp_path):
    out = tmp_path / "new.yaml"
    with open_rig(load_rig(small_rig())):
        code, report, err = acquire("init", "--out", out)
    assert code == 0, err
    assert "1 camera(s)" in report
    assert load_rig(out).camera.device == "SIM-1"
    text = out.read_text()
    assert acquire("init", "--out", out)[0] == 2
    assert out.read_text() == text


def test_without_devices_it_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(init, "find_cameras", lambda: ([], "no Aravis"))
    monkeypatch.setattr(init, "find_ports", list)
    init.write_rig(tmp_path / "empty.yaml")
    assert "No camera answered (no Aravis)" in (tmp_path / "empty.yaml").read_text()
    with pytest.raises(ProcessError, match="exists"):
        init.write_rig(tmp_path / "empty.yaml")


def test_devices_of_a_configuration_of_micro_manager_are_listed(acquire, tmp_path):
    bench = tmp_path / "bench.cfg"
    bench.write_text("# made by hand\nProperty,Core,Initialize,0\nDevice,Rotator,DemoCamera,DStage\nLabel,x,0,y\n")
    acquire.made("init", "--out", tmp_path / "rig.yaml", "--micromanager", bench)
    text = (tmp_path / "rig.yaml").read_text()
    assert "#  Rotator: DemoCamera DStage\n" in text
    assert f"kind: mmcore, device: LABEL, configuration: {bench}" in text
    load_rig(tmp_path / "rig.yaml")
    bench.write_text("Device,Rotator\n")
    err = acquire.refused("init", "--out", tmp_path / "other.yaml", "--micromanager", bench)
    assert "Save it in Micro-Manager" in err
    assert not (tmp_path / "other.yaml").exists()
