"""Promise 20 for what comes from other labs: states files, pictures, stacks, measured tensors."""

import struct
import sys
import zlib
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from processing.doors import MOST_PIXELS, ProcessError, require_picture
from processing.reflectance.pbsdf import load as load_pbsdf
from processing.storage.formats.frame_files import read_frame
from processing.storage.formats.tensor_file import create_tensor_file

ROOT = Path(__file__).resolve().parents[2]
INSTRUMENT = ROOT / "configs" / "instruments" / "rgb950.yaml"


@pytest.fixture
def states(tmp_path):
    """Writes states.csv, with 18 frames beside it."""
    for k in range(18):
        cv2.imwrite(str(tmp_path / f"f{k}.png"), np.full((4, 6), 100 + k, np.uint16))
    rows = [["state", "psg_deg", "psa_deg", "file"], *([k, 20 * k, 98.2 * k, f"f{k}.png"] for k in range(18))]

    def write(change=lambda rows: None, files=True):
        change(rows)
        path = tmp_path / "states.csv"
        columns = rows if files else [row[:-1] for row in rows]
        path.write_text("\n".join(",".join(map(str, row)) for row in columns) + "\n")
        return path

    return write


def _cell(row, column, text):
    return lambda rows: rows[row].__setitem__(column, text)


def _column(name):
    def add(rows):
        for k, row in enumerate(rows):
            row.insert(1, name if k == 0 else 0.0)

    return add


def _roles_dark(rows):
    for k, row in enumerate(rows):
        row.insert(1, "dark" if k else "role")


STATES = {
    "axis called detector": (_column("detector"), "detector"),
    "axis called beam": (_column("beam_deg"), "beam"),
    "axis without a name": (_column(""), "empty name"),
    "axis with a path": (_column("../x"), "letters"),
    "axis twice": (_column("psg"), "given twice"),
    "every role dark": (_roles_dark, "every state is dark"),
    "a row missing": (lambda rows: rows.pop(5), "state 4 is missing"),
    "one file twice": (_cell(7, 3, "f2.png"), "f2.png is given already in line 4"),
    "state of 400 digits": (_cell(3, 0, "9" * 400), "whole number"),
    "state in other digits": (_cell(3, 0, "²"), "whole number"),
    "a name that no file has": (_cell(3, 3, "9" * 5000), "no such frame"),
    "no file": (_cell(3, 3, ""), "no name"),
    "missing frame": (_cell(8, 3, "gone.png"), "states.csv:9: column file: no such frame: "),
    "no number": (_cell(6, 1, "fortyfive"), "states.csv:7: column psg: 'fortyfive' is not a finite"),
    "nan": (_cell(6, 1, "nan"), "states.csv:7: column psg: 'nan' is not a finite"),
    "no column": (_cell(0, 2, "psa_angle"), "states.csv:1: no column psa"),
    "state twice": (_cell(7, 0, 5), "states.csv:8: state 5 is given already in line 7"),
    "short row": (lambda rows: rows[7].pop(1), "states.csv:8: 3 columns, the header has 4"),
    "no rows": (lambda rows: rows.__delitem__(slice(1, None)), "needs a header line and one row per state"),
    "no exposure": (_column("exposure_s"), "column exposure_s: 0 is not above 0"),
}


@pytest.mark.parametrize("name", STATES)
def test_states_csv(states, process_refuses, tmp_path, name):
    change, word = STATES[name]
    arguments = ("--states", states(change), "--wavelength-nm", 662, "--instrument", INSTRUMENT)
    assert word in process_refuses("import", *arguments)
    assert not list(tmp_path.glob("*.h5*"))


def _png(path, wide, high):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", wide, high, 16, 0, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 100_000)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def test_picture_that_promises_terabytes(states, tmp_path, process_refuses):
    _png(tmp_path / "f0.png", 12_000, 12_000)
    _png(tmp_path / "terabytes.png", 1_000_000, 1_000_000)
    arguments = ("--states", states(), "--wavelength-nm", 662, "--instrument", INSTRUMENT)
    assert f"at most {MOST_PIXELS:,} pixels" in process_refuses("import", *arguments)
    with pytest.raises(ProcessError, match="pixels"):
        require_picture(tmp_path / "terabytes.png")


def test_picture_cut_short(states, tmp_path, process_refuses):
    picture = tmp_path / "f3.png"
    cv2.imwrite(str(picture), np.random.default_rng(1).integers(0, 4000, (4, 6)).astype(np.uint16))
    picture.write_bytes(picture.read_bytes()[:-30])
    arguments = ("--states", states(), "--wavelength-nm", 662, "--instrument", INSTRUMENT)
    assert "f3.png" in process_refuses("import", *arguments)


@pytest.mark.parametrize("frame", [np.full((4, 6, 3), 4000, np.uint16), np.full((4, 6), 70000, np.int32)])
def test_pictures_that_only_opencv_reads_as_they_are(frame, tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "deep.tif"), frame)
    read = read_frame(tmp_path / "deep.tif")
    assert read.dtype == frame.dtype
    assert np.array_equal(read, frame.reshape(4, 6, -1)[..., 0])
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ProcessError, match=r"needs cv2: pip install 'umov\[fast\]'"):
        read_frame(tmp_path / "deep.tif")


def _stack_h5(path):
    with h5py.File(path, "w") as h5:
        h5["group/frames"] = np.zeros((18, 4, 6), "u2")
        h5["group/text"] = "x"
        h5.create_dataset("huge", (18, 1 << 20, 1 << 20), "u2", chunks=(1, 64, 64))


STACKS = {
    "group": (_stack_h5, "::/group", "no dataset"),
    "text": (_stack_h5, "::/group/text", "shape|holds"),
    "nothing": (_stack_h5, "::/nothing", "no dataset"),
    "terabytes": (_stack_h5, "::/huge", "bytes"),
    "npy of a number": (lambda path: np.save(path, np.float64(3)), "", "shape"),
    "npy of objects": (lambda path: np.save(path, np.array([{}], dtype=object), allow_pickle=True), "", "read|holds"),
    "npy of complex": (lambda path: np.save(path, np.zeros((18, 4, 6), "c8")), "", "holds"),
    "npy without pixels": (lambda path: np.save(path, np.zeros((18, 0, 6))), "", "pixels|read"),
    "npy cut short": (lambda path: path.write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr'z"), "", "read"),
    "npy without a number": (lambda path: np.save(path, np.full((18, 4, 6), np.nan)), "", "no finite value"),
    "empty": (lambda path: path.write_bytes(b""), "", "read"),
}  # fmt: skip


@pytest.mark.parametrize("name", STACKS)
def test_stack(states, tmp_path, process_refuses, name):
    import re

    make, inside, word = STACKS[name]
    path = tmp_path / ("stack.h5" if inside else "stack.npy")
    make(path)
    arguments = ("--states", states(files=False), "--wavelength-nm", 662, "--instrument", INSTRUMENT)
    err = process_refuses("import", *arguments, "--stack", f"{path}{inside}")
    assert re.search(word, err), err


def test_pbsdf_of_other_shapes(tmp_path):
    shapes = {"theta_h": (1, 91), "theta_d": (1, 91), "phi_d": (1, 361), "wvls": (5,), "M": (3, 3, 3, 5, 4, 4)}
    path = tmp_path / "x.pbsdf"
    fields = create_tensor_file(path, {name: (shape, np.float32) for name, shape in shapes.items()})
    fields["theta_h"][0] = np.deg2rad(90 * (np.arange(91) / 90) ** 2)
    fields["theta_d"][0] = np.deg2rad(np.arange(91))
    fields["phi_d"][0] = np.deg2rad(np.arange(-180, 181))
    for field in fields.values():
        field.flush()
    with pytest.raises(ProcessError, match="M is float32"):
        load_pbsdf(path)
    # A shape whose product overflows 64 bits.
    data = bytearray(path.read_bytes())
    at = data.index(b"M") + 1 + 11
    data[at : at + 48] = struct.pack("<6Q", *[1 << 40] * 6)
    path.write_bytes(data)
    with pytest.raises(ProcessError, match="truncated"):
        load_pbsdf(path)
