"""A capture that is being written is shown as far as it is done, and who looks keeps no run from its file."""

import contextlib
import json
import urllib.error
import urllib.request

import h5py
import numpy as np
import pytest

from acquisition.capture.layout import put_layout
from acquisition.capture.partial_file import finish
from acquisition.capture.state_file import StateFile
from acquisition.errors import AcquisitionError
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader, create_layout
from viewer.library import Library


def asked(address, page):
    with urllib.request.urlopen(f"{address}/{page}") as answer:
        return answer.read()


def test_states_appear_as_they_are_written(lab, address):
    partial = lab / "now.h5.partial"
    header = CaptureHeader(title="now", simulated=True, mode="drr", wavelength_nm=662)
    angles = {"psg": np.arange(5.0)}
    put_layout(
        partial,
        1 << 20,
        lambda h5: create_layout(
            h5, header, angles, ("sample",) * 5, frame_shape=(6, 8), dtype=np.uint16, start_time="2026-01-01T00:00:00"
        ),
    )
    # Open as a run has it: locked against every other program.
    with contextlib.closing(StateFile(partial)) as file:
        with pytest.raises(AcquisitionError, match="another program has it open"):
            StateFile(partial)
        for state in range(3):
            frame = np.full((1, 6, 8), 700 + state, np.uint16)
            file.write_state(state, frame, {"psg": (state, state)}, {"exposure_s": 0.01})
            states = json.loads(asked(address, "states?file=now.h5.partial"))
            assert (len(states["number"]), states["planned"], states["status"]) == (state + 1, 5, "running")
            counts = np.frombuffer(asked(address, "frame?file=now.h5.partial&state=-1"), "<f4")[:48]
            assert np.all(counts == 700 + state)
        assert 'data-writing="yes"' in asked(address, "capture?file=now.h5.partial").decode()
        curve = json.loads(asked(address, "curve?file=now.h5.partial&x0=1&y0=1"))
        assert curve["counts"] == [700, 701, 702]
        assert "the fit comes when it is complete" in curve["told"]
    # The run may take its file again although the page has just looked.
    StateFile(partial).close()


def test_a_capture_that_is_sealed_while_somebody_reads_it_is_complete_afterwards(lab):
    partial = lab / "now.h5.partial"
    header = CaptureHeader(title="now", simulated=True, mode="drr", wavelength_nm=662)
    angles = {"psg": np.arange(1.0)}
    put_layout(
        partial,
        1 << 20,
        lambda h5: create_layout(
            h5, header, angles, ("sample",), frame_shape=(6, 8), dtype=np.uint16, start_time="2026-01-01T00:00:00"
        ),
    )
    library = Library(lab)
    # HDF5 takes what it has of a file that is open already, whatever its name: a picture that is being read, say.
    with Capture(partial):
        # As a run does it, who has the file locked.
        raw = partial.read_bytes()
        with partial.open("r+b") as file:
            file.seek(raw.index(b"running\0"))
            file.write(b"complete")
        finish(partial)
        assert [entry.name for entry in library.entries()] == ["now.h5"]
    assert library.entry("now.h5").status == "complete"


def test_a_capture_without_a_state_says_so(lab, address, drr_capture):
    path = drr_capture("now.h5", shape=(6, 8))
    with h5py.File(path, "r+") as h5:
        h5["entry/states/done"][...] = 0
    assert b"0 of 44" in asked(address, "capture?file=now.h5")
    with pytest.raises(urllib.error.HTTPError) as refused:
        asked(address, "frame?file=now.h5&state=-1")
    assert refused.value.code == 422
    assert b"0 states done" in refused.value.read()
    refused.value.close()
