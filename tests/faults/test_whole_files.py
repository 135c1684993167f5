"""On a full disc nothing is left of a report or an export, and what was there is as it was."""

import errno
import resource
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from processing.commands.application import main
from processing.errors import ProcessError
from processing.storage.captures.schema import CaptureHeader, Detector
from processing.storage.products.product import Plane
from processing.storage.products.product_writer import ProductWriter
from processing.whole_file import whole_file, write_new_text, write_whole_text
from tests.commands import exit_code

SHAPE = (20, 30)
WRITERS = {**{to: ("export", "--to", to) for to in ("csv", "tiff", "mat", "fits", "png")}, "html": ("report",)}
ENDINGS = {"tiff": ".mueller.tif"}


@pytest.fixture(scope="module")
def product(tmp_path_factory):
    header = CaptureHeader(
        title="noise", simulated=True, mode="drr", wavelength_nm=662, detector=Detector(), channels=("camera",)
    )
    values = np.random.default_rng(1).normal(1000, 1, (4, 4, *SHAPE)).astype(np.float32)
    planes = {"mueller": Plane((4, 4), "count", "M"), "mueller_errors": Plane((4, 4), "count", "its errors")}
    path = tmp_path_factory.mktemp("product") / "image.h5"
    with ProductWriter(path, "mueller", header, SHAPE, planes=planes, steps=()) as writer:
        writer.write(slice(0, SHAPE[0]), mueller=values, mueller_errors=values * 0 + 1)
        return writer.seal({"warnings": []})


@contextmanager
def full_disc(most_bytes=1000):
    """Files of this process cannot grow further: what a full disc looks like to it."""
    before, bytecode = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    # Python would keep the first bytes of a module that it imports here as the whole of it.
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = bytecode


@pytest.mark.parametrize(
    ("kind", "exists"),
    [
        # A report draws and writes a picture too.
        pytest.param(kind, kind in ("csv", "html"), marks=[pytest.mark.long] * (kind == "png"))
        for kind in WRITERS
    ],
)
def test_a_full_disc_leaves_nothing_half(product, kind, exists, tmp_path, capsys):
    command, *options = WRITERS[kind]
    out = tmp_path / f"out{ENDINGS.get(kind, f'.{kind}')}"
    planes = [] if kind in ("html", "png") else ["--plane", "mueller"]
    if exists:
        out.write_text("of yesterday")
    words = [command, str(product), *options, *planes, "--out", str(tmp_path / f"out.{kind}"), "--overwrite"]
    with full_disc(), pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 1
    assert "File too large" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ([out.name] if exists else [])
    if exists:
        assert out.read_text() == "of yesterday"
    assert exit_code(main, *words) == 0
    assert out.stat().st_size > 1000


def test_a_link_stays_a_link_and_a_pipe_is_written_to(tmp_path):
    (tmp_path / "target.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("target.txt")
    write_whole_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "target.txt").read_text() == "new"
    write_whole_text(Path("/dev/null"), "gone")
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_comes_while_another_is_written_stays(tmp_path, monkeypatch, links):
    def refused(*_):
        raise OSError(errno.EPERM, "no links on this disc")

    if not links:
        monkeypatch.setattr("os.link", refused)
    path = tmp_path / "report.html"

    def late():
        with whole_file(path, new=True) as new:
            new.write_text("mine")
            path.write_text("of somebody else")

    with pytest.raises(FileExistsError):
        late()
    assert path.read_text() == "of somebody else"
    path.unlink()
    write_new_text(path, "mine")
    assert path.read_text() == "mine"
    with pytest.raises(ProcessError, match="exists and is not replaced"):
        write_new_text(path, "yours")
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]
