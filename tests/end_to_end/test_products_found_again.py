"""A product is found again by what it was made of: no result depends on what was run before, no file is replaced."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.campaign.executors import executor
from processing.campaign.run import ProcessedCampaign
from processing.commands.application import main
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.reflectance.tables import ScatteringTable, table_steps
from processing.steps.maps import Quantities, Xi0, geometry_identities
from processing.steps.reduction import Reduction, reduce_or_open
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.integrity.checksums import row_crc32, write_checksums
from processing.storage.products import provenance
from processing.storage.products.product import Product
from processing.storage.products.provenance import content_of, file_identity, made_of
from simulators.bench.bench import SimulatedBench
from simulators.bench.scene import Scene
from simulators.bench.virtual_capture import write_virtual_capture
from tests.commands import exit_code

Run = Callable[..., str]


@pytest.fixture
def process(process: Callable[..., tuple[int, str, str]]) -> Run:
    """Runs `process ARGS`, which has to succeed; standard output."""

    return process.made


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, configs: Path) -> Path:
    """A small simulated capture with noise."""
    path = tmp_path_factory.mktemp("original") / "c.h5"
    instrument = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    bench = SimulatedBench(Scene.load(configs / "scenes/red_sphere.yaml"), instrument, 662, rows=24, columns=24, seed=1)
    write_virtual_capture(path, bench, instrument, 35, states=40, darks=2)
    return path


@pytest.fixture
def capture(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(original, tmp_path / "c.h5"))


@pytest.fixture
def edited(configs: Path, tmp_path: Path) -> Path:
    """An instrument file that gives other numbers."""
    text = (configs / "instruments/rgb950.yaml").read_text()
    assert "662: 127.12" in text
    path = tmp_path / "other.yaml"
    path.write_text(text.replace("662: 127.12", "662: 117.0"))
    return path


def xi0_of(product: Path) -> np.ndarray:
    with Product(product) as opened:
        return opened.get("xi0")


@pytest.fixture(scope="module")
def truth(original: Path, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """xi0 of the capture where nothing was run before."""
    fresh = tmp_path_factory.mktemp("fresh")
    shutil.copy(original, fresh / "c.h5")
    return xi0_of(Xi0(Reduction(fresh / "c.h5").make()).make())


@pytest.mark.parametrize("touched", [False, True], ids=["product newer", "capture newer"])
def test_a_weighted_product_is_neither_replaced_nor_taken_for_the_plain_one(capture, process, truth, touched):
    process("reduce", capture, "--weighted", "--no-figure")
    product = capture.with_suffix(".mueller.h5")
    content = product.read_bytes()
    if touched:
        later = product.stat().st_mtime + 100
        os.utime(capture, (later, later))
    process("xi0", capture, "--no-figure")
    assert product.read_bytes() == content
    np.testing.assert_array_equal(xi0_of(capture.with_suffix(".xi0.h5")), truth)
    # The plain product has a name of its own, and is found again by it.
    (weighted,) = capture.parent.glob("c.mueller-*.h5")
    assert weighted.stem.endswith((made_of(weighted) or "")[:8])
    assert f"using {weighted}" in process("xi0", capture, "--no-figure", "--overwrite")


def test_xi0_does_not_depend_on_the_instrument_used_before(capture, edited, process, truth):
    process("xi0", capture, "--instrument", edited, "--out", capture.with_name("other.h5"), "--no-figure")
    assert np.nanmedian(np.abs(xi0_of(capture.with_name("other.h5")) - truth)) > 0.003
    process("xi0", capture, "--no-figure")
    np.testing.assert_array_equal(xi0_of(capture.with_suffix(".xi0.h5")), truth)
    # Nor does that with the other instrument depend on the plain one.
    process("xi0", capture, "--instrument", edited, "--out", capture.with_name("again.h5"), "--no-figure")
    np.testing.assert_array_equal(xi0_of(capture.with_name("again.h5")), xi0_of(capture.with_name("other.h5")))
    edited.write_text(edited.read_text().replace("117.0", "127.12"))
    process("xi0", capture, "--instrument", edited, "--out", capture.with_name("right.h5"), "--no-figure")
    np.testing.assert_allclose(xi0_of(capture.with_name("right.h5")), truth, atol=1e-6)


def test_time_stamps_and_places_count_for_nothing(capture, edited, process, tmp_path):
    process("reduce", capture, "--no-figure")
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("c.h5", "c.mueller.h5"):
        shutil.copy(capture.with_name(name), moved / name)
    future = 2e9
    os.utime(moved / "c.h5", (future, future))
    assert f"using {moved / 'c.mueller.h5'}" in process("quantities", moved / "c.h5", "--no-figure")
    # Another capture of the same name and with the older time stamp is not what the product was made of.
    bench_like = shutil.copy(capture, tmp_path / "second.h5")
    with provenance.h5py.File(bench_like, "r+") as h5:
        # Frames have checksums, so that a changed one would be refused; a word beside them will do.
        h5["entry"].attrs["comment"] = "another capture"
    shutil.copy(bench_like, moved / "c.h5")
    os.utime(moved / "c.h5", (1e9, 1e9))
    assert "using" not in process("xi0", moved / "c.h5", "--no-figure")
    assert len(list(moved.glob("c.mueller-*.h5"))) == 1


def test_what_a_step_is_made_of(capture, edited, tmp_path, monkeypatch):
    plain = Reduction(capture)
    keys = [plain.record().made_of]
    changed = [replace(plain, weighted=True), replace(plain, physical="nearest"), replace(plain, instrument=edited)]
    changed += [
        replace(plain, weighted=True, covariance=True),
        replace(plain, dark=capture),
        replace(plain, flat=(capture,)),
    ]
    for step in changed:
        assert step.record().made_of not in keys
        keys.append(step.record().made_of)
    monkeypatch.setattr(provenance, "program", lambda: "another")
    assert plain.record().made_of not in keys
    monkeypatch.undo()
    product = plain.make()
    assert made_of(product) == plain.record().made_of == keys[0]
    # A later step knows its source by what that was made of, so that making it again changes nothing.
    first = Quantities(product).record().made_of
    plain.make(overwrite=True)
    assert Quantities(product).record().made_of == first
    plain_again = replace(plain, weighted=True).make(overwrite=True)
    assert Quantities(plain_again).record().made_of != first


def test_the_checksums_of_a_capture_s_frames_stand_for_them(capture):
    """Products are found without reading every frame of their captures anew: 40 frames of 5 Mpixels are 400 MB."""
    before = content_of(file_identity(capture))
    raw = capture.read_bytes()
    with Capture(capture) as opened:
        frame = opened.frames(3)
    at = raw.index(frame.tobytes())
    # Other counts with the old checksums are no capture that can be read, and nothing is made of them.
    capture.write_bytes(raw[: at + 9] + bytes([raw[at + 9] ^ 1]) + raw[at + 10 :])
    assert content_of(file_identity(capture)) == before
    with pytest.raises(CaptureError, match="changed on the disc"):
        Reduction(capture).make()
    # With checksums of their own they are another capture.
    with provenance.h5py.File(capture, "r+") as h5:
        write_checksums(h5["entry"], row_crc32(h5["entry/instrument/detector/data"][...]))
    assert content_of(file_identity(capture)) != before


@pytest.mark.parametrize("place", [0.0, 0.25, 0.5, 0.75, 0.999])
def test_every_byte_beside_the_frames_counts(capture, place):
    before, raw = content_of(file_identity(capture)), capture.read_bytes()
    with provenance.h5py.File(capture, "r") as h5:
        frames = h5["entry/instrument/detector/data"]
        chunks = [frames.id.get_chunk_info(k) for k in range(frames.id.get_num_chunks())]
    beside = np.ones(len(raw), dtype=bool)
    for chunk in chunks:
        beside[chunk.byte_offset : chunk.byte_offset + chunk.size] = False
    at = int(np.flatnonzero(beside)[int(place * beside.sum())])
    capture.write_bytes(raw[:at] + bytes([raw[at] ^ 1]) + raw[at + 1 :])
    assert content_of(file_identity(capture)) != before


def test_a_capture_with_a_state_without_checksum_is_known_by_all_its_bytes(capture):
    assert "sha256_without_frames" in file_identity(capture)
    with provenance.h5py.File(capture, "r+") as h5:
        h5["entry/states/crc32"][5] = -1
    assert "sha256" in file_identity(capture)


def test_the_mesh_of_a_geometry_file_is_an_input(capture, configs, tmp_path):
    mesh = tmp_path / "cube.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = (configs / "geometries/one_inch_sphere.yaml").read_text()
    head = text[: text.index("shape:")]
    (tmp_path / "g.yaml").write_text(head + "shape:\n  kind: mesh\n  file: cube.obj\n")
    before = geometry_identities(tmp_path / "g.yaml")
    assert [i["role"] for i in before] == ["geometry", "mesh"]
    mesh.write_text("v 0 0 0\nv 2 0 0\nv 0 1 0\nf 1 2 3\n")
    after = geometry_identities(tmp_path / "g.yaml")
    assert before[0] == after[0]
    assert before[1]["sha256"] != after[1]["sha256"]


def test_names_that_are_taken_are_refused(capture, configs, tmp_path):
    step = Reduction(capture)
    step.make()
    with pytest.raises(ProcessError, match="exists"):
        step.make()
    with pytest.raises(ProcessError, match="is reduced already"):
        reduce_or_open(step.usual_path, configs / "instruments/rgb950.yaml")


def test_campaign_makes_nothing_twice_and_takes_nothing_for_another(original, configs, tmp_path):
    folder, out = tmp_path / "campaign", tmp_path / "out"
    folder.mkdir()
    shutil.copy(original, folder / "c.h5")
    files = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"

    def run() -> dict[str, bytes]:
        with executor(1) as pool:
            ProcessedCampaign(folder, out, *files).run(pool)
        return {path.name: path.read_bytes() for path in out.glob("*.mueller*.h5") if "table" not in path.name}

    first = run()
    os.utime(folder / "c.h5", (2e9, 2e9))
    assert run() == first
    Reduction(folder / "c.h5", weighted=True).make(out / "c.mueller.h5", overwrite=True)
    weighted = (out / "c.mueller.h5").read_bytes()
    products = run()
    assert products["c.mueller.h5"] == weighted
    assert len(products) == 2


def test_a_table_is_not_replaced_and_counts_no_image_twice(capture, configs, process, tmp_path, capfd):
    product = Reduction(capture).make()
    geometry, out = configs / "geometries/one_inch_sphere.yaml", tmp_path / "t.h5"
    table = ("table", product, "--geometry", geometry, "--out", out)
    process(*table)
    count, content = ScatteringTable.load(out).count.sum(), out.read_bytes()
    assert [s.name for s in table_steps(out)] == ["table"]
    for options, message in (((), "exists"), (("--append",), "would count twice")):
        assert exit_code(main, *table, *options) == 2
        assert message in capfd.readouterr().err
        assert out.read_bytes() == content
    weighted = Reduction(capture, weighted=True).make(tmp_path / "w.h5")
    process("table", weighted, *table[2:], "--append")
    assert ScatteringTable.load(out).count.sum() == 2 * count
    assert [[i["role"] for i in s.inputs] for s in table_steps(out)] == [
        ["source", "geometry"],
        ["source", "geometry", "table"],
    ]
    process(*table, "--overwrite")
    assert ScatteringTable.load(out).count.sum() == count
