"""Files given twice would count twice; a disc without room is told before HDF5 meets it, which ends the process."""

import errno
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from acquisition.capture.partial_file import check_space
from acquisition.errors import AcquisitionError
from processing import doors
from processing.commands.application import main as process
from processing.commands.diagnose import main as diagnose
from processing.errors import ProcessError
from processing.storage.captures.schema import CaptureHeader, Detector
from processing.storage.formats.foreign_arrays import ImportFailed
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.importing import import_capture
from processing.storage.products.product import Plane, ProductError
from processing.storage.products.product_writer import ProductWriter
from tests.commands import exit_code

TWICE = {
    "calibrate": (process, ["--instrument", "i.yaml", "--free", "x"]),
    "camera": (process, []),
    "table": (process, ["--geometry", "g.yaml", "--out", "t.h5"]),
    "fit-material": (process, ["--geometry", "g.yaml", "--out", "m.yaml"]),
    "diagnose": (diagnose, ["--instrument", "i.yaml"]),
}


@pytest.mark.parametrize("name", TWICE)
def test_a_file_given_twice_is_refused(name, configs, tmp_path, capfd, monkeypatch):
    """It halved the variance of what is fitted: the same noise was taken for two."""
    main, options = TWICE[name]
    file, link = tmp_path / "one.h5", tmp_path / "other.h5"
    file.write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    shutil.copy(configs / "geometries/one_inch_sphere.yaml", tmp_path / "g.yaml")
    link.symlink_to(file)
    assert exit_code(main, *([name] if main is process else []), file, link, *options) == 2
    assert f"{link} is given twice, also as {file}" in capfd.readouterr().err


def product(path):
    header = CaptureHeader(
        title="", simulated=True, mode="drr", wavelength_nm=662, detector=Detector(), channels=("camera",)
    )
    return ProductWriter(path, "mueller", header, (50, 40), planes={"mueller": Plane((4, 4), "count", "M")}, steps=())


@pytest.mark.parametrize("free", [0, 127_999, 200_000])
def test_a_disc_without_room_is_told_before_anything_is_written(free, tmp_path, monkeypatch):
    monkeypatch.setattr(doors.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    with pytest.raises(ProductError, match=rf"m\.h5\.partial needs \d+,\d+ bytes, {free:,} are free"):
        product(tmp_path / "m.h5")
    states = tmp_path / "states.csv"
    np.save(tmp_path / "f.npy", np.ones((2, 50, 40)))
    states.write_text("state,psa_deg\n0,0\n1,30\n")
    with pytest.raises(ImportFailed, match=r"c\.h5\.partial needs \d+,\d+ bytes"):
        import_capture(ImportRequest(states, tmp_path / "c.h5", 550, stack=str(tmp_path / "f.npy")))
    assert not list(tmp_path.glob("*.partial"))


def test_a_product_that_is_made_has_its_space(tmp_path, monkeypatch):
    """A long file with nothing behind it would meet the full disc inside HDF5, in the middle of a flush."""
    with product(tmp_path / "m.h5"):
        assert (tmp_path / "m.h5.partial").stat().st_blocks * 512 >= 50 * 40 * 16 * 4

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(ProductError, match="No space left on device"):
        product(tmp_path / "n.h5")


def test_a_folder_that_takes_no_files_is_told_before_the_work(tmp_path, monkeypatch):
    """A medium that is read-only: `acquire --dry-run` passed, and the run was refused."""
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ProcessError, match=rf"m\.h5: nothing can be written into {tmp_path}"):
        product(tmp_path / "m.h5")
    with pytest.raises(AcquisitionError, match=f"nothing can be written into {tmp_path}"):
        check_space(tmp_path, 1)
