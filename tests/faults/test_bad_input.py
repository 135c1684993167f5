"""Promise 20: a hostile or damaged file is refused: a line a mistake, no traceback, soon, in little memory."""

import json
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from processing.doors import ProcessError, parse_json, read_text
from processing.instrument.states import rotating_retarders
from processing.reduction.instrument_of_capture import choose_model
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.product import Product, ProductError, Step
from processing.yaml_file import MOST_BYTES, ConfigError, load_yaml

ROOT = Path(__file__).resolve().parents[2]
INSTRUMENT = ROOT / "configs" / "instruments" / "rgb950.yaml"


# --- YAML -------------------------------------------------------------------------------------------------

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(10)
)
YAML_FILES = {
    "merges itself": ("a: &a {<<: *a, b: 1}\n", "contains itself"),
    "holds itself": ("&a\na: *a\n", "contains itself"),
    "anchor bomb": (BOMB, "values"),
    "deep lists": ("a: " + "[" * 100_000, "nested deeper"),
    "deep mappings": ("a: " + "{a: " * 50_000, "nested deeper"),
    "many values": ("a: [" + "0, " * 60_000 + "0]\n", "values"),
    "date that is none": ("title: 2001-99-99\n", "can be read"),
    "number of 5000 digits": ("omega_deg: " + "9" * 5000 + "\n", "can be read"),
    "control characters": ("title: \x07\n", "can be read"),
    "list at the top": ("- a\n- b\n", "keys and values"),
    "ordered map": ("!!omap [a: 1]\n", "a: unknown key"),
    "two documents": ("a: 1\n---\na: 2\n", "document"),
    "not a number": ("omega_deg: .nan\n", "finite"),
    "infinite": ("exposure_s: 1e999\n", "finite"),
    "infinite in a merge": ("states: {kind: table, angles: {<<: {psg: [.inf]}}}\n", "finite"),
    "steps of more than a turn": ("states: {kind: rotating_retarders, step_deg: 1.0e+308}\n", "step_deg: must be 360"),
    "matrix of three": ("sample: {kind: mueller, mueller: [1, 2, 3]}\n", "mueller"),
    "matrix not a number": ("sample: {kind: mueller, mueller: [" + "1, " * 15 + ".nan]}\n", "finite"),
    "matrix missing": ("sample: {kind: mueller}\n", "mueller"),
    "a thousand mistakes": ("".join(f"k{n}: 1\n" for n in range(1000)), "and 970 more"),
}  # fmt: skip


@pytest.mark.parametrize("name", YAML_FILES)
def test_yaml(acquire_refuses, tmp_path, name):
    text, word = YAML_FILES[name]
    plan = tmp_path / "plan.yaml"
    plan.write_text(text)
    err = acquire_refuses("--plan", plan, "--dry-run", "--out", tmp_path)
    assert word in err, err
    assert str(plan) in err


@pytest.mark.parametrize("text", [".nan", "nan", "'inf'", "1e999", "{.inf: 90}"])
def test_a_retardance_that_is_no_number(tmp_path, text):
    from processing.instrument.model import InstrumentModel

    path = tmp_path / "instrument.yaml"
    text_of_file = INSTRUMENT.with_name("drr_imaging_630nm.yaml").read_text()
    path.write_text(text_of_file.replace("retardance_deg: 90}", f"retardance_deg: {text}}}", 1))
    with pytest.raises(ConfigError, match=r"instrument\.yaml:\d+: .*retardance_deg.*finite"):
        load_yaml(path, InstrumentModel)


def test_yaml_of_any_size_is_not_even_read(tmp_path):
    from acquisition.capture.plan import MeasurementPlan

    path = tmp_path / "plan.yaml"
    with path.open("w") as file:
        file.truncate(50 << 20)
    with pytest.raises(ConfigError, match="at most"):
        load_yaml(path, MeasurementPlan)
    path.write_text("#\n" * (MOST_BYTES // 8))
    start_s = time.process_time()
    with pytest.raises(ConfigError, match="keys and values"):
        load_yaml(path, MeasurementPlan)
    assert time.process_time() - start_s < 5


def test_what_is_no_file_is_not_waited_for(tmp_path):
    import os

    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(ProcessError, match=r"regular file|folder"):
            read_text(path)


CAMPAIGNS = {
    "no angles": ("omega_deg: []", "omega_deg"),
    "a reference in an unknown mode": ("references: [{sample: {name: x}, omega_deg: 35, modes: [drrr]}]", "drrr"),
    "a million angles": ("omega_deg: {start: 0, stop: 180, step: 1.0e-6}", "angles"),
    "a plan that is not there": ("plans: {drr: drrr.yaml}", "drrr.yaml: cannot be read"),
    "no plans": ("plans: {}", "plans"),
}


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_campaign_file(acquire_refuses, tmp_path, name):
    line, word = CAMPAIGNS[name]
    keys = {"name": "x", "plans": "{drr: drr.yaml}", "samples": "[{name: red_sphere}]", "wavelengths_nm": "[662]",
            "omega_deg": "[35]"}  # fmt: skip
    key, _, value = line.partition(": ")
    path = tmp_path / "campaign.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in (keys | {key: value}).items()))
    assert word in acquire_refuses("--campaign", path, "--dry-run", "--out", tmp_path)


INDEXES = ["{", "[]", '{"a": 1}', "\x00", "[" * 5000, '{"a": NaN}', '{"a": {"x": ' + "9" * 5000 + "}}", ""]


@pytest.mark.parametrize("text", INDEXES, ids=range(len(INDEXES)))
def test_damaged_books_of_a_campaign(tmp_path, caplog, text):
    from acquisition.campaign.log import CampaignFolder
    from acquisition.campaign.plan import Campaign

    campaign = Campaign.load(ROOT / "configs" / "campaigns" / "red_sphere.yaml")
    CampaignFolder(tmp_path, campaign).close()
    (tmp_path / "index.json").write_text(text)
    # It can be made anew from the captures, so a campaign goes on without it, and says so.
    folder = CampaignFolder(tmp_path, campaign)
    assert folder.index == {}
    assert "index.json" in caplog.text
    folder.close()
    (tmp_path / "campaign.yaml").write_bytes(b"\xff\xfe kind: \x00")
    with pytest.raises(ConfigError, match=r"campaign\.yaml"):
        CampaignFolder(tmp_path, campaign)


@pytest.mark.parametrize("text", ["{", "[]", '{"rig": 3}', "\x00", "[" * 5000], ids=range(5))
def test_damaged_identity_of_a_campaign(tmp_path, text):
    from acquisition.campaign.identity import read_identity

    (tmp_path / "identity.json").write_text(text)
    with pytest.raises(ProcessError, match=r"identity\.json"):
        read_identity(tmp_path)


def test_json_is_finite_and_shallow():
    assert parse_json('{"a": [1.5]}', "x") == {"a": [1.5]}
    for text in ("[Infinity]", "[" * 50 + "]" * 50, "{'a': 1}", "9" * 5000):
        with pytest.raises(ProcessError, match=r"^x: is not the JSON"):
            parse_json(text, "x")


# --- captures ---------------------------------------------------------------------------------------------


@pytest.fixture
def capture(synthetic_capture):
    table = rotating_retarders(0.01, 24, 15)
    frames = np.random.default_rng(1).integers(64, 4000, (24, 1, 6, 8)).astype(np.uint16)
    return synthetic_capture(frames, dict(table.angles_deg), instrument_yaml=INSTRUMENT.read_text())


def _replace(h5, name, value):
    del h5[name]
    h5[name] = value


def _header(h5, **changes):
    header = json.loads(h5["entry"].attrs["header_json"])
    header["detector"] |= changes
    h5["entry"].attrs["header_json"] = json.dumps(header)


def _huge(h5):
    del h5["entry/instrument/detector/data"]
    h5.create_dataset("entry/instrument/detector/data", (24, 1, 1 << 20, 1 << 20), "u2", chunks=(1, 1, 64, 64))


CAPTURES = {
    "no column": lambda h5: h5["entry/states"].pop("exposure_s"),
    "short column": lambda h5: _replace(h5, "entry/states/frame_id", np.zeros(3, int)),
    "column of text": lambda h5: _replace(h5, "entry/states/exposure_s", [b"x"] * 24),
    "column that is a group": lambda h5: (h5["entry/states"].pop("done"), h5.create_group("entry/states/done")),
    "done is a float": lambda h5: _replace(h5, "entry/states/done", np.full(24, 0.5)),
    "done 7": lambda h5: h5["entry/states/done"].write_direct(np.full(24, 7, np.uint8)),
    "bits 1e9": lambda h5: _header(h5, bits=10**9),
    "bits 0": lambda h5: _header(h5, bits=0),
    "black level no number": lambda h5: _header(h5, black_level_counts=float("nan")),
    "unknown role": lambda h5: _replace(h5, "entry/states/role", [b"smaple"] * 24),
    "short angles": lambda h5: _replace(h5, "entry/instrument/psg/value", np.zeros(2)),
    "frames of two dimensions": lambda h5: _replace(h5, "entry/instrument/detector/data", np.zeros((24, 3), "u2")),
    "frames of two channels": lambda h5: _replace(h5, "entry/instrument/detector/data", np.zeros((24, 2, 6, 8), "u2")),
    "complex frames": lambda h5: _replace(h5, "entry/instrument/detector/data", np.zeros((24, 1, 6, 8), "c8")),
    "frames of a terabyte": _huge,
    "no header": lambda h5: h5["entry"].attrs.pop("header_json"),
    "header of numbers": lambda h5: h5["entry"].attrs.create("header_json", 3),
    "header in ruins": lambda h5: h5["entry"].attrs.modify("header_json", "{"),
    "unknown status": lambda h5: h5["entry"].attrs.modify("status", "fine"),
    "schema of text": lambda h5: h5.attrs.create("umov_schema", "x"),
    "entry is data": lambda h5: _replace(h5, "entry", 3),
}  # fmt: skip


@pytest.mark.parametrize("name", CAPTURES)
def test_capture(capture, process_refuses, name):
    with h5py.File(capture, "r+") as h5:
        CAPTURES[name](h5)
    with pytest.raises(CaptureError) as error:
        Capture(capture)
    assert len(str(error.value).splitlines()) == 1
    assert str(capture) in process_refuses("reduce", capture)


def test_a_capture_cut_short_or_of_other_bytes(capture):
    data = capture.read_bytes()
    for spoilt in (b"", data[:100], data[: len(data) // 2], b"\0" * 5000, b"kind: plan\n"):
        capture.write_bytes(spoilt)
        with pytest.raises(CaptureError):
            Capture(capture)


@pytest.mark.parametrize("attribute", ["units", "long_name"])
def test_a_plane_that_does_not_say_what_it_is(capture, tmp_path, attribute):
    path = tmp_path / "image.h5"
    with Capture(capture) as opened:
        reduce_mueller(opened, choose_model(opened, None), path, (Step("reduce", {}),))
    with h5py.File(path, "r+") as h5:
        del h5["entry/data/mueller"].attrs[attribute]
    with Product(path) as product, pytest.raises(ProductError, match="is damaged"):
        getattr(product, attribute)("mueller")
