"""A run seen from outside: what it says of itself, its grid, the time left, the lamp, and what a page starts."""

import json
import os
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquisition.screen.observer import StateReport
from acquisition.screen.run_file import RunFile, running_in, start_ticks
from drivers.motion import Position
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from viewer.campaigns import read_campaign, seconds_left
from viewer.following import run_state
from viewer.jobs import Jobs
from viewer.lamp import lamp
from viewer.library import Library, NotHere
from viewer.starting import KINDS


def until(condition):
    while not (value := condition()):
        time.sleep(0.01)
    return value


def report(number):
    positions = {"psg": Position(9.0 * number, number), "lcr": Position(1.53, 1.53, unit="V")}
    return StateReport(number, "sample", positions, 0.01, 0.0, 0.0, 1e5, np.zeros((4, 4), np.uint16))


def test_a_run_says_where_it_is_while_it_runs_and_nothing_afterwards(lab):
    with RunFile(lab, simulated=True) as run_file:
        run_file.campaign_progress(2, 5, "three.h5")
        run_file.run_started("red sphere", None, 44, None)
        for number in range(41):
            run_file.state_done(report(number))
        run_file.warning("a wire is loose")
        facts = until(lambda: (run := running_in(lab)) and run["done"] == 41 and run["messages"] and run)
        assert (facts["capture"], facts["campaign_total"], facts["pending"]) == ("three.h5", 5, 44)
        assert "a wire is loose" in facts["messages"][0]
        assert facts["left_s"] >= 0
        shown = run_state(lab, Library(lab))
        assert (shown["number"], shown["total"]) == (3, 5)
        # The axis stands at its second turn.
        assert shown["axes"] == {"psg": "0.000°", "lcr": "1.530 V"}
    assert running_in(lab) is None
    assert list(lab.iterdir()) == []


def test_a_process_that_has_ended_or_another_with_its_number_runs_nothing(lab):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    own_process = {"pid": os.getpid(), "begun_ticks": start_ticks(os.getpid()) - 1}
    for name, facts in (
        ("1", {"pid": ended.pid, "begun_ticks": 5}),
        ("2", own_process),
        ("3", {"pid": "x"}),
        ("4", []),
    ):
        (lab / f".run-{name}.json").write_text(json.dumps(facts))
    (lab / ".run-5.json").write_text("{half a")
    # Killed while it wrote, before its first version and after it.
    (lab / ".run-6.new").write_text("{half a")
    (lab / ".run-1.new").write_text("{half a")
    assert running_in(lab) is None
    # The next run takes away what they have left behind.
    with RunFile(lab, simulated=False):
        until(lambda: running_in(lab))
    assert list(lab.iterdir()) == []


def test_a_folder_that_cannot_be_written_keeps_no_run_from_measuring(lab):
    with RunFile(lab / "gone", simulated=False) as run_file:
        run_file.run_started("x", None, 3, None)
        run_file.state_done(report(0))


def campaign(lab, drr_capture):
    """A campaign of five captures: complete, flagged, aborted, unreadable, and one that is not there."""
    folder = lab / "night"
    folder.mkdir()
    for name in ("1.h5", "2.h5", "3.h5"):
        drr_capture(f"night/{name}", shape=(4, 4))
    with h5py.File(folder / "2.h5", "r+") as h5:
        h5["entry/states/saturated_fraction"][...] = 0.2
    with h5py.File(folder / "3.h5", "r+") as h5:
        h5["entry/states/done"][20:] = 0
        h5["entry"].attrs.modify("status", np.array(b"aborted", dtype=h5["entry"].attrs["status"].dtype))
    (folder / "4.h5").write_bytes(b"broken")
    plan = {
        f"{k}.h5": {
            "mode": "drr",
            "wavelength_nm": 662,
            "omega_deg": 30 + k,
            "sample": {"name": "leaf", "kind": "unknown"},
        }
        for k in range(1, 6)
    }
    (folder / "identity.json").write_text(json.dumps({"plan": plan, "simulated": True, "rig_file": "rig.yaml"}))
    (folder / "index.json").write_text("{}")
    lines = [
        {"time": "2026-01-01T20:00:00+00:00", "event": "campaign started"},
        {"time": "2026-01-01T20:00:00+00:00", "event": "capture started", "capture": "1.h5"},
        {
            "time": "2026-01-01T20:01:00+00:00",
            "event": "capture ended",
            "capture": "1.h5",
            "status": "complete",
            "states": 44,
        },
        {"time": "2026-01-01T20:01:00+00:00", "event": "capture started", "capture": "2.h5"},
    ]
    (folder / "log.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + '\n{"time": "cut o')
    return folder


def test_each_capture_of_a_campaign_has_its_sign(lab, client, drr_capture):
    folder = campaign(lab, drr_capture)
    view = read_campaign(folder, Library(lab), running=None)
    assert [cell.status for cell in view.cells] == ["done", "flagged", "partial", "failed", "missing"]
    assert "20 % of the pixels" in view.cells[1].remark.replace("20.00", "20")
    assert [(bar.name, bar.status) for bar in view.bars] == [("1.h5", "done"), ("2.h5", "partial")]
    # Killed: the log does not say when, the file says when its last state came.
    written = datetime.fromtimestamp((folder / "2.h5").stat().st_mtime, UTC)
    assert datetime.fromisoformat(view.bars[1].end) == written
    (*_, last) = read_campaign(folder, Library(lab), running="2.h5").bars
    assert (last.status, last.end) == ("running", None)
    (block,) = view.blocks()
    assert block.angles_deg == (31, 32, 33, 34, 35)
    # What is running now is running, whatever its file looks like.
    assert read_campaign(folder, Library(lab), running="3.h5").cells[2].status == "running"
    page = client.get("/campaign", params={"folder": "night"}).text
    assert "2 of 5" in page
    assert client.get("/campaign", params={"folder": "."}).status_code == 404


def test_a_capture_that_ends_while_the_page_is_made_is_shown(lab, drr_capture):
    folder = campaign(lab, drr_capture)
    capture = folder / "1.h5"
    partial = capture.rename(f"{capture}.partial")

    class Ending(Library):
        def holds(self, path):
            holds_path = super().holds(path)
            if path == partial and holds_path:
                partial.rename(capture)
            return holds_path

    (shown,) = [cell for cell in read_campaign(folder, Ending(lab)).cells if cell.name == capture.name]
    assert shown.status == "done"


def test_the_time_left_is_what_captures_have_taken(lab, drr_capture):
    view = read_campaign(campaign(lab, drr_capture), Library(lab), running="3.h5")
    # One minute each for the two that are failed and missing, and the rest of the one that runs.
    assert seconds_left(view, {"left_s": 20.0, "pending": 44, "done": 30}) == 2 * 60 + 20
    fresh = type(view)(view.name, True, "", view.cells, (), ())
    assert seconds_left(fresh, {"left_s": 30.0, "pending": 40, "done": 10}) == pytest.approx(2 * 40 + 30)
    assert seconds_left(fresh, {"left_s": None}) is None


@pytest.fixture
def flickering(drr_capture, configs):
    """A capture whose frame means are modulated by polarization, and whose lamp was 1 % brighter in one state."""
    model = InstrumentModel.load(configs / "instruments" / "rgb950.yaml").at(662)
    path = drr_capture("lamp.h5", shape=(4, 4))
    with h5py.File(path, "r+") as h5:
        angles = {name: h5[f"entry/instrument/{name}/value"][4:] for name in ("psg", "psa")}
        mean = model.rows(angles, None).reshape(40, 16) @ np.diag([1.0, 0.5, 0.4, 0.3]).reshape(16) * 1e5
        mean[17] *= 1.01
        # The pedestal of the dark states is in every frame.
        h5["entry/states/monitor"][...] = np.concatenate([np.zeros(4), mean]) + 3000
    return path


def test_the_lamp_is_told_from_polarization(flickering):
    with Capture(flickering) as capture:
        source = lamp(capture)
        modulated = capture.column("monitor")[4:]
    assert np.ptp(modulated) / modulated.mean() > 0.3
    ratio = np.array(source["ratio"])
    assert source["states"][int(np.argmax(ratio))] == 21
    assert ratio.max() == pytest.approx(1.01, abs=1e-6)
    assert np.std(np.delete(ratio, 17)) < 0.002


@pytest.mark.parametrize("name", ["mosaic_polarimeter", "drr_wollaston"])
def test_the_lamp_is_told_where_a_frame_holds_several_channels(name, configs, synthetic_capture):
    file = configs / "instruments" / f"{name}.yaml"
    model, angles = InstrumentModel.load(file), {"psg": 7.3 * np.arange(30)}
    m = np.diag([1, 0.6, 0.5, 0.3])
    m[0, 1:] = 0.3, 0.2, 0.1
    of_frame = 1000 * (model.rows(angles) @ m.ravel()).mean(axis=1)
    of_frame[21] *= 1.01
    frames = np.zeros((30, 1 if model.mosaic else 2, 4, 4), np.uint16)
    more = {"mosaic": model.mosaic, "channels": ("mosaic",)} if model.mosaic else {"channels": ("left", "right")}
    path = synthetic_capture(frames, angles, instrument_yaml=file.read_text(), **more)
    with h5py.File(path, "r+") as h5:
        h5["entry/states/monitor"][...] = of_frame
    with Capture(path) as capture:
        source = lamp(capture)
    assert np.ptp(of_frame) / of_frame.mean() > 0.1
    ratio = np.array(source["ratio"])
    assert source["states"][int(np.argmax(ratio))] == 21
    assert ratio.max() == pytest.approx(1.01, abs=1e-6)


def test_a_few_states_tell_no_lamp_yet(flickering):
    with h5py.File(flickering, "r+") as h5:
        h5["entry/states/done"][15:] = 0
    with Capture(flickering) as capture:
        assert lamp(capture)["ratio"] == []
    with h5py.File(flickering, "r+") as h5:
        h5["entry/states/done"][...] = 0
    with Capture(flickering) as capture:
        assert lamp(capture)["told"] == "no light state is done yet"


def test_a_command_is_followed_to_its_end_and_known_afterwards(lab, client, drr_capture, monkeypatch):
    monkeypatch.setenv("UMOV_DOOR", "./lab")
    drr_capture("one.h5", shape=(4, 4))
    origin = {"origin": "http://127.0.0.1:8000"}
    answer = client.post("/start", json={"what": "reduce", "file": "one.h5"}, headers=origin)
    assert answer.status_code == 200, answer.text
    (job,) = Jobs(lab).all()
    until(lambda: Jobs(lab).status(job) == "done")
    assert (lab / "one.mueller.h5").exists()
    page = client.get("/job", params={"name": job.name}).text
    assert "./lab process reduce" in page
    assert "mueller: one.mueller.h5" in page
    refused = client.post("/stop-job", json={"name": job.name}, headers=origin)
    assert (refused.status_code, "ended already" in refused.text) == (422, True)


@pytest.mark.parametrize(
    "order",
    [
        {"what": "shell"},
        {"what": "reduce", "file": "../one.h5"},
        {"what": "campaign", "file": "/etc/passwd"},
        {"what": "reduce", "file": "one.h5", "instrument": "../../x.yaml"},
        {"what": "diagnose", "files": "one.h5", "instrument": "nobody.yaml"},
        {"what": "diagnose", "files": ""},
        {"what": 3},
        ["what"],
    ],
)
def test_nothing_else_is_started(lab, client, drr_capture, order):
    drr_capture("one.h5", shape=(4, 4))
    answer = client.post("/start", json=order, headers={"origin": "http://127.0.0.1:8000"})
    assert answer.status_code in (404, 422)
    assert Jobs(lab).all() == []


class Told:
    """Takes a command in place of `Jobs`."""

    def start(self, title, command, about, folder):
        return command


def test_a_surface_is_diagnosed_with_a_material_and_a_geometry(lab, client, drr_capture, configs):
    drr_capture("one.h5")
    (lab / "mine.yaml").write_text((configs / "materials/red_print.yaml").read_text())
    (lab / "ball.yaml").write_text((configs / "geometries/one_inch_sphere.yaml").read_text())
    page = client.get("/capture", params={"file": "one.h5"}).text
    for name in ("mine.yaml", "ball.yaml", "example: red_print", "example: one_inch_sphere"):
        assert f"<option>{name}</option>" in page
    order = {"files": "one.h5", "material": "mine.yaml", "geometry": "example: one_inch_sphere"}
    command = KINDS["surface"](Library(lab), Told(), order)
    options = dict(zip(command[2::2], command[3::2], strict=True))
    assert Path(options["--reflectance"]).read_text() == (lab / "mine.yaml").read_text()
    assert ViewingGeometry.load(options["--geometry"]) == ViewingGeometry.load(lab / "ball.yaml")
    assert Path(options["--instrument"]).read_text() == (configs / "instruments/rgb950.yaml").read_text()
    # A mesh is found from the copy as well.
    text = (lab / "ball.yaml").read_text().replace("{kind: sphere, radius_mm: 12.7}", "{kind: mesh, file: vase.stl}")
    (lab / "vase.yaml").write_text(text)
    command = KINDS["surface"](Library(lab), Told(), order | {"geometry": "vase.yaml"})
    copied = ViewingGeometry.load(command[command.index("--geometry") + 1])
    assert copied == ViewingGeometry.load(lab / "vase.yaml")
    assert copied.shape.file == str(lab / "vase.stl")
    with pytest.raises(NotHere, match="no such material"):
        KINDS["surface"](Library(lab), Told(), order | {"material": "/etc/passwd"})


def test_a_product_of_another_instrument_file_is_called_what_it_is(lab, drr_capture):
    mosaic = {"mosaic": (("90", "45"), ("135", "0")), "instrument_yaml": ""}
    for name, header in (("mueller", {}), ("stokes", mosaic)):
        drr_capture("one.h5", shape=(4, 4), **header)
        order = {"file": "one.h5", "instrument": "example: rgb950"}
        assert KINDS["reduce"](Library(lab), Told(), order)[-1] == str(lab / f"one.rgb950.{name}.h5")


def test_a_job_that_was_cut_off_takes_no_page_away(lab, client):
    folder = lab / ".umov-view" / "jobs" / "1"
    folder.mkdir(parents=True)
    (folder / "job.json").write_text('{"name": "1", "ti')
    assert client.get("/").status_code == 200


@pytest.mark.parametrize("name", ["", "..", "../../x", "nothing", "x" * 300, "x" * 5000, "a/b", "a\0b"])
def test_a_job_or_a_diagnosis_that_is_not_there(client, name):
    for page in ("job", "diagnosis", "diagnosis-report", "residual-map"):
        assert client.get(f"/{page}", params={"name": name}).status_code == 404
