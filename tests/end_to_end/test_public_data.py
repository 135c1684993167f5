"""`data list` and `data get`: from a server, from a folder without a network, and every file by its SHA-256."""

import gc
import hashlib
import http.server
import json
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from acquisition.commands.public_data import main
from processing.public_data import sets
from processing.public_data.sets import SHIPPED, PublicSet, SetFile, catalogue
from processing.storage.captures.capture import Capture

NAME, COMMIT = "drr-wollaston-nir", "0123abcd"
PAGE = Path(__file__).parents[2] / "docs" / "measured-data.md"


@pytest.fixture
def data(run_main, tmp_path, monkeypatch):
    """Run `data ARGS` in a folder of its own; returns exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("UMOV_DATA", raising=False)
    return partial(run_main, main)


@pytest.fixture
def source(tmp_path) -> Path:
    """Files of a set as its repository has them at a commit."""
    folder = tmp_path / "served" / COMMIT / "deep"
    folder.mkdir(parents=True)
    theta = np.radians(np.arange(0, 184, 4.0))[::-1]
    for file, prefix in (("cal_results.json", "Cal_"), ("sample_results.json", "")):
        light = 1000 * (1 + 0.5 * np.cos(8 * theta))
        values = {"theta1300": theta, "Il_1300": light, "Ir_1300": 2000 - light}
        text = json.dumps({f"{prefix}{key}": value.tolist() for key, value in values.items()})
        (folder / file).write_text(text)
    return folder


@pytest.fixture
def requests(source, monkeypatch, tmp_path):
    """The catalogue holds one set, whose repository is on this machine; returns the requests that were made."""
    paths: list[str] = []

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            paths.append(self.path)

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path / "served"))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    files = [
        SetFile(path=f"deep/{path.name}", sha256=hashlib.sha256(path.read_bytes()).hexdigest())
        for path in sorted(source.iterdir())
    ]
    public_set = PublicSet(
        title="two channels",
        source=f"http://127.0.0.1:{server.server_port}",
        commit=COMMIT,
        licence="MIT",
        citation="A. Nobody",
        instrument="drr_wollaston.yaml",
        files=tuple(files),
    )
    monkeypatch.setattr(sets, "catalogue", lambda: {NAME: public_set})
    monkeypatch.setattr("processing.public_data.sets.SHIPPED", tmp_path / "nothing")
    yield paths
    server.shutdown()
    thread.join()
    server.server_close()
    # While this test's own filter of warnings holds, not during a later one.
    gc.collect()


def test_a_set_is_downloaded_once_and_becomes_captures(data, requests, tmp_path):
    code, out, _ = data("get", NAME)
    assert (code, len(requests)) == (0, 2)
    assert "licence: MIT" in out
    assert "2 inputs: 2 made, 0 unchanged, 0 failed" in out
    with Capture(tmp_path / "data" / NAME / "air_1300nm.h5") as capture:
        assert capture.header.sample.kind == "air"
        assert not capture.simulated
        # Sorted by angle.
        np.testing.assert_allclose(capture.angles_deg["psg"], np.arange(0, 184, 4.0), atol=1e-9)
        np.testing.assert_allclose(capture.frames(0)[:, 0, 0], [1500, 500])
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*")}
    code, out, _ = data("get", NAME)
    assert (code, len(requests)) == (0, 2)
    assert "2 inputs: 0 made, 2 unchanged, 0 failed" in out
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*")} == written


def test_other_content_than_that_of_the_catalogue_is_refused(data, requests, source, tmp_path):
    (source / "cal_results.json").write_text("{}")
    code, _, err = data("get", NAME)
    assert code == 2
    assert "cannot be downloaded" in err
    assert f"UMOV_DATA=DATA ./lab data get {NAME}" in err
    assert not (tmp_path / "data" / NAME / "air_1300nm.h5").exists()


# requests leaves the socket of an answer 404 to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_folder_in_place_of_the_network(data, requests, source, tmp_path, monkeypatch):
    folder = tmp_path / "own" / NAME
    folder.mkdir(parents=True)
    for file in source.iterdir():
        file.rename(folder / file.name)
    monkeypatch.setenv("UMOV_DATA", str(tmp_path / "own"))
    code, _, _ = data("get", NAME, "--out", tmp_path / "made")
    assert (code, requests) == (0, [])
    assert (tmp_path / "made" / "plate_1300nm.h5").exists()
    # A changed file is not taken for it.
    (folder / "cal_results.json").write_text("{}")
    code, _, err = data("get", NAME)
    assert (code, "cannot be downloaded" in err) == (2, True)
    monkeypatch.setenv("UMOV_DATA", str(tmp_path / "elsewhere"))
    code, _, err = data("get", NAME)
    assert (code, "no such folder" in err) == (2, True)


def test_what_the_repository_holds_needs_no_network(data):
    code, out, _ = data("get", "ptfe-mueller-brdf")
    assert (code, out.splitlines()[-1]) == (0, str(SHIPPED / "ptfe-mueller-brdf/PTFE.data.csv"))
    code, _, err = data("get", "ptfe")
    assert (code, "there is no data set 'ptfe'" in err) == (2, True)


def test_list_and_page_name_source_commit_licence_and_citation(data):
    _, out, _ = data("list")
    page = PAGE.read_text(encoding="utf-8")
    for name, entry in catalogue().items():
        for text in (name, entry.licence, entry.source, entry.doi):
            assert text in out
            assert text in page
        assert entry.citation in out
        assert entry.commit[:12] in out
        assert entry.commit in page
        assert all(len(file.sha256) == 64 for file in entry.all_files())


def test_every_shipped_set_has_a_licence_and_a_source():
    entries = catalogue()
    folders = [path for path in SHIPPED.iterdir() if path.is_dir()]
    assert {path.name for path in folders} == {name for name, entry in entries.items() if entry.in_repository}
    for folder in folders:
        about = (folder / "README.md").read_text(encoding="utf-8")
        assert entries[folder.name].source in about
        assert entries[folder.name].commit in about
        assert (folder / "LICENSE").exists() or "creativecommons.org/licenses/by/4.0" in about
