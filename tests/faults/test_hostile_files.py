"""Promises 20 and 31: what is no plain file, lies elsewhere, or cannot be meant is refused at once, in words."""

import os
import time
import zipfile

import h5py
import numpy as np
import pytest

from acquisition.campaign.log import CampaignFolder
from acquisition.campaign.plan import Campaign
from acquisition.capture.layout import put_layout
from acquisition.capture.operator import Operator
from acquisition.capture.plan import MeasurementPlan
from acquisition.commands.single import say_simulated
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.screen.rows import say
from acquisition.stop_request import StopRequest
from processing.storage.captures.capture import CaptureError
from processing.storage.captures.schema import CaptureHeader
from processing.storage.integrity.h5_door import read_npy
from processing.yaml_file import ConfigError, parse_yaml
from tests.rig_files import change_yaml

SHORT = {"states": {"kind": "table", "angles": {"psg": [0.0, 10.0, 20.0]}}, "darks": 1, "mode": "stokes"}


#: The partial capture that many tests spoil, taken once.
TAKEN = {}


@pytest.fixture
def partial(run_with, quick_rig, tmp_path):
    def act(rig, state, retake):
        if state == 2:
            raise AcquisitionError("enough")

    if not TAKEN:
        TAKEN["bytes"] = run_with(act, plan=SHORT)[1].read_bytes()
    quick_rig()
    copy = tmp_path / "copy" / "run.h5.partial"
    copy.parent.mkdir()
    copy.write_bytes(TAKEN["bytes"])
    return copy


@pytest.fixture
def quickly():
    """Fails where something hangs: a pipe that nobody writes to holds its reader for ever."""
    begin_s = time.monotonic()
    yield
    assert time.monotonic() - begin_s < 60


def linked_out(h5, pipe):
    del h5["entry/title"]
    h5["entry/title"] = h5py.ExternalLink(str(pipe), "/x")


def stored_out(h5, pipe):
    h5["entry"].create_dataset("more", (4,), "u1", external=[(str(pipe), 0, 4)])


def virtual(h5, pipe):
    layout = h5py.VirtualLayout((4,), "u1")
    layout[:] = h5py.VirtualSource(str(pipe), "x", shape=(4,))
    h5["entry"].create_virtual_dataset("more", layout)


@pytest.mark.parametrize("spoil", [linked_out, stored_out, virtual])
def test_a_file_whose_parts_lie_elsewhere_is_refused(
    spoil, partial, process_refuses, acquire_refuses, quickly, tmp_path
):
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(partial, "r+") as h5:
        spoil(h5, tmp_path / "pipe")
    assert "another file" in process_refuses("reduce", partial)
    assert "another file" in acquire_refuses("--resume", partial, "--rig", tmp_path / "rig.yaml")


NO_FILES = {
    "pipe": os.mkfifo,
    "circle of links": lambda path: path.symlink_to(path.name),
    "device": lambda path: path.symlink_to("/dev/zero"),
    # It says that it is a file of no bytes, and reading it does not end.
    "file of the kernel": lambda path: path.symlink_to("/proc/kmsg"),
}


@pytest.mark.parametrize("put", NO_FILES.values(), ids=NO_FILES)
def test_no_option_waits_for_what_is_no_file(
    put, acquire, process_refuses, quickly, synthetic_capture, configs, tmp_path
):
    capture = synthetic_capture(np.ones((4, 1, 8, 8), "u2"), {"psg": np.arange(4.0)})
    instrument = configs / "instruments" / "rgb950.yaml"
    put(tmp_path / "odd.h5")
    odd = tmp_path / "odd.h5"
    for option in ("--rig", "--plan", "--campaign", "--resume", "--out"):
        code, _, err = acquire(option, odd, "--dry-run")
        assert code in (1, 2), (option, err)
        assert "Traceback" not in err
        assert "not answered" not in err
    for command in ("reduce", "mean", "camera"):
        assert process_refuses(command, odd)
    assert process_refuses("calibrate-mosaic", capture, "--instrument", odd)
    options = ("--instrument", instrument, "--wavelength", 662, "--out", tmp_path / "out.h5")
    assert process_refuses("import", "--states", odd, *options)


def test_a_circle_of_links_is_no_place_for_a_product(process, synthetic_capture, tmp_path):
    loop = tmp_path / "loop.h5"
    loop.symlink_to("loop.h5")
    capture = synthetic_capture(np.ones((4, 1, 8, 8), "u2"), {"psg": np.arange(4.0)})
    for command in ("reduce", "mean", "export"):
        code, _, err = process(command, capture, "--out", loop)
        assert code == 2, (command, err)


@pytest.mark.parametrize(
    "put", [os.mkfifo, lambda path: path.symlink_to("victim"), lambda path: os.link("victim", path)]
)
def test_what_others_put_in_the_place_of_our_files_is_not_written(put, configs, tmp_path, monkeypatch, quickly):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "victim").write_text("precious")
    campaign = Campaign.load(configs / "campaigns" / "red_sphere.yaml")
    (tmp_path / "other").mkdir()
    put(tmp_path / "other" / ".lock")
    with pytest.raises(AcquisitionError, match=r"\.lock cannot be written"):
        CampaignFolder(tmp_path / "other", campaign)
    folder = CampaignFolder(tmp_path / "night", campaign)
    put(tmp_path / "night" / "log.jsonl")
    with pytest.raises(AcquisitionError, match=r"log\.jsonl cannot be written"):
        folder.log("x")
    put(tmp_path / "night" / "index.json.new")
    with pytest.raises(AcquisitionError, match=r"index\.json cannot be written"):
        folder.record("x")
    folder.close()
    put(tmp_path / "001.h5.new")
    with pytest.raises(OSError):
        put_layout(tmp_path / "001.h5.new", 1000, lambda h5: None, b"")
    assert (tmp_path / "victim").read_text() == "precious"


def test_a_zip_named_npy_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npy", "w") as archive:
        archive.writestr("x", b"PK")
    for data in (None, b"PK\x03\x04broken", b"\x93NUM"):
        if data is not None:
            (tmp_path / "a.npy").write_bytes(data)
        with pytest.raises(CaptureError, match=r"no \.npy file"):
            read_npy(tmp_path / "a.npy", CaptureError)


@pytest.mark.parametrize(
    "changes",
    [
        {"wavelength_nm": 0}, {"wavelength_nm": -5}, {"seed": 10**30}, {"title": "a\x1b[2Jb"},
        {"sample": {"name": "a\x9b"}},
        {"mosaic": [["90", "45"], ["135"]]}, {"mosaic": [[]]}, {"channels": ["a\x07"]}, {"mode": "drr\n"},
    ],
)  # fmt: skip
def test_a_header_that_cannot_be_meant_is_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        CaptureHeader.model_validate({"title": "t", "simulated": False, "mode": "drr", "wavelength_nm": 662} | changes)


def set_targets(value):
    def spoil(h5):
        h5["entry/instrument/psg/target_value"][2] = value

    return spoil


def set_schema(h5):
    h5.attrs["umov_schema"] = 2.5


def set_exposure(value):
    def spoil(h5):
        h5["entry/states/exposure_s"][2] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (set_targets(np.nan), "state 2"), (set_targets(11.0), "state 2"), (set_targets(1e308), "state 2"),
        (set_schema, "2.5"), (set_exposure(0.0), "exposure of 0 s"), (set_exposure(-1.0), "exposure of -1 s"),
    ],
)  # fmt: skip
def test_a_resume_does_not_go_where_the_plan_does_not(spoil, message, partial, acquire, tmp_path):
    with h5py.File(partial, "r+") as h5:
        spoil(h5)
    code, _, err = acquire("--resume", partial, "--rig", tmp_path / "rig.yaml")
    assert code in (1, 2)
    assert message in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("omega_deg: 1.0e+308", "beyond anything"), ("omega_deg: 4_5", "without _"), ("omega_deg: '4_5'", "without _"),
        ('title: "a\\e[2Jb"', "control characters"), ('"\\e": 1', "control characters"),
        ('title: "\\u202eb"', "control characters"), ("exposure_s: -1", "positive"), ("exposure_s: 0", "positive"),
    ],
)  # fmt: skip
def test_a_plan_that_cannot_be_meant_is_refused(text, message):
    with pytest.raises(ConfigError, match=message) as refused:
        parse_yaml(f"kind: plan\n{text}\n", MeasurementPlan)
    assert "\x1b" not in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("wavelengths_nm", [451, 451], "wavelength 451"), ("omega_deg", [30, 30.0], "angle 30"),
        ("samples", [{"name": "a"}, {"name": "a"}], "sample a"), ("exposure_s", {451: 0.0, 662: 0.1}, "exposure_s"),
        ("exposure_s", {451: -1.0}, "exposure_s"), ("omega_deg", [1e300], "beyond"),
    ],
)  # fmt: skip
def test_a_campaign_that_cannot_be_meant_is_refused(key, value, message, configs, tmp_path):
    source, path = configs / "campaigns" / "red_sphere.yaml", tmp_path / "c.yaml"
    with pytest.raises(ConfigError, match=message):
        Campaign.load(change_yaml(source, lambda campaign: campaign.update({key: value}), to=path))


def test_a_seed_that_no_generator_takes_is_refused(acquire):
    for seed in (10**30, -1):
        assert "Traceback" not in acquire.refused("--omega", 35, "--seed", seed, "--dry-run")


@pytest.mark.parametrize("name", ["foil [wet]", "foil [dry]", "tile [/A]", "[bold]x", "a:b", "\\[x"])
def test_a_name_reaches_the_operator_as_it_is(name, capsys):
    from functools import partial as bound

    from rich.console import Console

    console = Console(width=40)
    operator = Operator(bound(say, console), StopRequest(), yes=True, simulated=False)
    operator.prepare(MeasurementPlan().with_changes(sample={"name": name}))
    assert f"place the sample: {name} (--yes)" in capsys.readouterr().out
    say_simulated(console, RigConfig.model_construct(name=name, simulated=True))
    assert repr(name) in capsys.readouterr().out


def test_control_sequences_of_names_and_files_do_not_reach_the_terminal(acquire, process_refuses, tmp_path):
    evil = tmp_path / "a\x1b[2Jb.yaml"
    evil.write_text("kind: rig\n")
    for arguments in (("--rig", evil), ("--sample", "x\x1b[2J"), ("--mode", "\x1b]0;x\x07"), ("--resume", evil)):
        code, out, err = acquire(*arguments, "--dry-run")
        assert code == 2, (arguments, out, err)
        assert "\x1b" not in out + err
        assert "\x07" not in out + err
    assert "\x1b" not in process_refuses("reduce", evil)
