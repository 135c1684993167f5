"""Promises 13 and 19: one capture is made with one plan, rig and set of devices; a resume forgets nothing."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import h5py
import pytest

from acquisition.capture.identity import devices_of, require_same_devices
from acquisition.capture.job import job_of
from acquisition.errors import Differs
from acquisition.rig.config import load_rig
from drivers.camera import CameraSettings
from drivers.errors import DeviceError
from processing.reduction.counts_to_signal import CountCorrection
from processing.reports.report import write_report
from processing.storage.captures.capture import Capture
from tests.rig_files import with_values


def broken_at(number):
    def act(rig, state, retake):
        if state == number:
            raise DeviceError("a device", "broke", "Mend it")

    return act


#: The partial capture that the tests below begin with, taken once.
TAKEN = {}


@pytest.fixture
def partial(run_with, tmp_path):
    if not TAKEN:
        error, path = run_with(broken_at(6))
        assert isinstance(error, DeviceError)
        assert path.name == "run.h5.partial"
        TAKEN["bytes"] = path.read_bytes()
    copy = tmp_path / "copy" / "run.h5.partial"
    copy.parent.mkdir()
    copy.write_bytes(TAKEN["bytes"])
    return copy


def _edited(rig_file, **changes):
    """A copy of a rig file with values at dotted keys (`a__b`) changed."""
    values = {key.replace("__", "."): value for key, value in changes.items()}
    return with_values(rig_file, values, rig_file.with_name("edited.yaml"))


def test_another_rig_is_refused_with_the_difference_in_words(partial, quick_rig):
    before = partial.read_bytes()
    rig = quick_rig()
    for changes, words in (
        ({"detector__black_level_counts": 70}, "rig.detector.black_level_counts: 64.0 at the start, 70.0 now"),
        ({"detector__gain_e_per_count": 1.3}, "rig.detector.gain_e_per_count: 2.6 at the start, 1.3 now"),
        ({"axes__psg__zero_deg": 3.5}, "rig.axes.psg.zero_deg: 0.0 at the start, 3.5 now"),
        ({"name": "another"}, "rig.name: simulated RGB950 at the start, another now"),
        ({"simulator__seed": 5}, "rig.simulator.seed: 1 at the start, 5 now"),
    ):
        with pytest.raises(Differs) as refused:
            job_of(partial, load_rig(_edited(rig, **changes)))
        assert words in str(refused.value)
    assert partial.read_bytes() == before


def test_a_real_capture_is_not_gone_on_with_on_a_simulated_rig(partial, quick_rig):
    with Capture(partial) as capture:
        began = capture.segments[0].identity
    assert began.simulated
    assert began.devices["psg"]["serial_number"]
    served = load_rig(_edited(quick_rig(), simulated=True)).model_copy(update={"simulated": False})
    with pytest.raises(Differs) as refused:
        job_of(partial, served)
    assert "simulated: True at the start, False now" in str(refused.value)


def test_where_a_device_is_plugged_in_may_differ(partial, quick_rig):
    moved = _edited(quick_rig(), axes__arm__port="/dev/ttyUSB7")
    assert len(job_of(partial, load_rig(moved)).table) == 19


def test_an_edited_instrument_or_scene_is_refused(run_with, configs, tmp_path):
    folder = shutil.copytree(configs, tmp_path / "configs")
    model, scene = folder / "instruments" / "rgb950.yaml", folder / "scenes" / "red_sphere.yaml"
    material = folder / "materials" / "red_print.yaml"
    modes = {"drr": {"instrument": str(model)}}
    _, path = run_with(broken_at(4), top={"modes": modes}, samples={"red_sphere": str(scene)})
    job_of(path)
    named = "content of the file.simulator.samples.red_sphere"
    for file, words in ((model, "instrument."), (scene, named), (material, f"{named}.material")):
        text = file.read_text()
        file.write_text(text.replace("13.41", "14.41") + "\n# edited\n")
        with pytest.raises(Differs) as refused:
            job_of(path)
        assert words in str(refused.value)
        file.write_text(text)
    job_of(path)


def test_other_devices_and_camera_settings_are_refused(partial):
    with Capture(partial) as capture:
        began = capture.segments[0]
        devices = {name: dict(device) for name, device in began.identity.devices.items()}
        settings = CameraSettings(**began.camera_settings)

        def rig(**camera):
            return SimpleNamespace(
                describe=lambda: devices,
                require_camera=lambda: SimpleNamespace(settings=settings.model_copy(update=camera)),
            )

        require_same_devices(capture, *devices_of(rig()))
        with pytest.raises(Differs, match=r"camera setting.gain_db: .* at the start, 6.0 now"):
            require_same_devices(capture, *devices_of(rig(gain_db=6.0)))
        devices["psa"]["serial_number"] = "another"
        with pytest.raises(Differs, match=r"device.psa.serial_number: 110002 at the start, another now"):
            require_same_devices(capture, *devices_of(rig()))


def test_plan_options_are_refused_with_resume(partial, acquire):
    for option in (("--omega", 50), ("--exposure", 0.5), ("--seed", 3)):
        assert f"{option[0]} has no meaning with --resume" in acquire.refused("--resume", partial, *option)


def test_as_new_keeps_apart(partial, quick_rig, acquire, intact):
    before = partial.read_bytes()
    edited_rig = _edited(quick_rig(), detector__black_level_counts=70)
    assert "--as-new" in acquire.refused("--resume", partial, "--rig", edited_rig)
    acquire.made("--resume", partial, "--rig", edited_rig, "--as-new")
    assert partial.read_bytes() == before
    assert intact(partial.parent / "run-2.h5") == 19


def assert_ends_with_its_text(path: Path) -> None:
    """Nothing stands behind the text of either record, in a file that is gone on with as in one that is sealed."""
    with h5py.File(path) as h5:
        texts = {name: h5[f"entry/{name}/json"] for name in ("closing", "segments")}
        # What h5py gives has no zero bytes at its end, whatever is stored.
        assert [text.dtype.itemsize for text in texts.values()] == [len(text[()]) for text in texts.values()]
        closing = json.loads(texts["closing"].asstr()[()])
        assert all(json.loads(line[9:]) for line in texts["segments"].asstr()[()].splitlines())
    with Capture(path) as capture:
        assert capture.closing == closing


def test_a_resume_is_a_recorded_segment_and_nothing_is_forgotten(run_with, tmp_path):
    def door(rig, state, retake):
        if state == 4:
            rig.simulation.emulators["shutter"].trip(True)

    error, path = run_with(door)
    assert "the door is open" in str(error)
    assert_ends_with_its_text(path)
    error, final = run_with(resume=path)
    assert error is None
    assert_ends_with_its_text(final)
    with Capture(final) as capture:
        first, second = capture.segments
        closing = capture.closing
        assert [*first.states, *second.states] == list(range(19))
        assert list(capture.run_of_states) == [0] * len(first.states) + [1] * len(second.states)
        assert any("taken in 2 runs" in text for text in CountCorrection.of(capture).warnings)
    assert (first.status, second.status) == ("failed", "complete")
    assert first.begun < first.ended <= second.begun < second.ended
    assert "process" in second.by
    assert first.identity == second.identity
    assert second.camera_settings["exposure_s"] == pytest.approx(0.02, rel=0.01)
    assert [event["why"] for event in first.interlocks] == ["the door is open in state 4"]
    assert closing["interlocks"] == list(first.interlocks)
    assert closing["messages"] == [*first.messages, *second.messages]
    assert any("resumed as segment 1" in text for text in closing["messages"])
    assert closing["ledger"]["total_s"] == pytest.approx(first.ledger["total_s"] + second.ledger["total_s"], abs=1e-3)
    assert closing["segments"] == 2
    assert "the door is open" in json.dumps(closing)
    page = tmp_path / "report.html"
    write_report([final], page, "two runs")
    assert "taken in 2 runs, between which the light may have jumped" in page.read_text()


def test_the_lamp_is_held_against_the_light_before_the_resume(run_with):
    top = {"interlocks": [{"kind": "lamp", "limit": 0.5}]}
    _, path = run_with(broken_at(6), top=top)
    error, path = run_with(resume=path, top=top, flux_e_per_s=8e4)
    assert "of that of the first state" in str(error)


def test_a_capture_begun_in_the_same_second_gets_the_next_name(
    acquire, quick_rig, plan_file, intact, monkeypatch, tmp_path
):
    monkeypatch.setattr("acquisition.commands.single.default_name", lambda plan: "same.h5")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/same.h5").write_bytes(b"of this second")
    out = acquire.made("--omega", 35, "--plan", plan_file, "--rig", quick_rig(), "--out", tmp_path / "out")
    assert "same-2.h5" in out
    assert intact(tmp_path / "out/same-2.h5") == 19
    assert (tmp_path / "out/same.h5").read_bytes() == b"of this second"
