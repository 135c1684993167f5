"""`acquire compress`: the same capture in fewer bytes, and only if it is whole."""

import h5py
import numpy as np
import pytest

from acquisition.capture.state_file import StateFile
from acquisition.errors import AcquisitionError
from processing.storage.captures.capture import Capture


def test_a_compressed_capture_is_the_same_capture(run_with, acquire, tmp_path):
    _, path = run_with()
    with Capture(path) as capture:
        frames = [capture.frames(k) for k in range(len(capture.done))]
        was = capture.header, capture.closing, capture.segments, capture.column("crc32")
    size = path.stat().st_size
    code, out, _ = acquire("compress", path.parent)
    assert code == 0
    assert "now" in out
    assert path.stat().st_size < size
    with Capture(path) as capture:
        for k, frame in enumerate(frames):
            np.testing.assert_array_equal(capture.frames(k), frame)
        assert (capture.header, capture.closing) == was[:2]
        assert [s.begun for s in capture.segments] == [s.begun for s in was[2]]
        np.testing.assert_array_equal(capture.column("crc32"), was[3])
    assert acquire("verify", path.parent)[0] == 0
    assert "compressed already" in acquire("compress", path.parent)[1]
    with pytest.raises(AcquisitionError, match="compressed"):
        StateFile(path)


def test_a_damaged_capture_stays_as_it_is(run_with, acquire):
    _, path = run_with()
    with h5py.File(path, "r+") as h5:
        h5["entry/instrument/detector/data"][3, 0, 0, 0] ^= 1
    raw = path.read_bytes()
    assert "damaged" in acquire("compress", path.parent)[1]
    assert path.read_bytes() == raw
    assert list(path.parent.glob("*.new")) == []
