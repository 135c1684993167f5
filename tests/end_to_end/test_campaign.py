"""A small campaign from simulated captures of both instruments through every command that reflectance has."""

import csv
import json
import os
import signal
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from processing.campaign.captures import find_captures
from processing.campaign.executors import executor
from processing.campaign.run import PAPER, CampaignResult, ProcessedCampaign
from processing.commands.application import main
from processing.errors import ProcessError
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.polarization.quantities import between, depolarization_index
from processing.reflectance.base import load_reflectance
from processing.reflectance.tables import ScatteringTable
from processing.storage.products.product import Product
from simulators.bench.bench import SimulatedBench
from simulators.bench.scene import Scene
from simulators.bench.virtual_capture import write_virtual_capture
from tests.commands import exit_code

ANGLES = (35.0, 60.0)
#: dask warns where a disc is slow, which another program can make it.
SLOW_DISC = pytest.mark.filterwarnings("ignore:Creating scratch directories")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, configs: Path) -> Path:
    """Both instruments at 662 nm and two arm angles; bright, so that the model and not the noise is seen."""
    where = tmp_path_factory.mktemp("campaign")
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    for kind, file, size, states in (("drr", "rgb950", 90, 40), ("stokes", "linear_stokes", 180, 4)):
        instrument = InstrumentModel.load(configs / f"instruments/{file}.yaml")
        detector = SimulatedBench(scene, instrument, 662).detector.model_copy(
            update={"full_well_e": 4e6, "gain_e_per_count": 100.0, "bits": 16}
        )
        for omega in ANGLES:
            bench = SimulatedBench(
                scene, instrument, 662, rows=size, columns=size, detector=detector, flux_e_per_s=1e8, seed=int(omega)
            )
            write_virtual_capture(where / f"{kind}_{omega:g}.h5", bench, instrument, omega, states=states, darks=2)
    return where


@pytest.fixture(scope="module")
def serial(folder: Path, configs: Path, tmp_path_factory: pytest.TempPathFactory) -> CampaignResult:
    """The campaign worked out in this process."""
    files = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    with executor(1) as pool:
        return ProcessedCampaign(folder, tmp_path_factory.mktemp("here"), *files).run(pool)


def options(configs: Path) -> list[object]:
    geometry, material = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    return ["--geometry", geometry, "--material", material]


def change_header(path: Path, **changes: object) -> None:
    with h5py.File(path, "r+") as h5:
        header = json.loads(h5["entry"].attrs["header_json"]) | changes
        h5["entry"].attrs["header_json"] = json.dumps(header)


@pytest.mark.usefixtures("figures")
def test_campaign_of_a_true_model_has_small_deviations(folder, configs, process):
    out = process.made("campaign", folder, *options(configs))
    assert "SIMULATED" in out
    # The averages are of one red sphere, not of any sample.
    assert not [line for line in out.splitlines() if line.split()[:1] == ["paper"]]
    table = (folder / "campaign/campaign.csv").read_text().splitlines()
    rows = [dict(zip(table[0].split(","), map(float, line.split(",")), strict=True)) for line in table[1:]]
    assert [r["omega_deg"] for r in rows] == list(ANGLES)
    for r in rows:
        assert r["psi_deg"] < 2
        assert r["magnitude_percent"] < 1.5
        assert r["xi0_percent"] < 1.0
        # So small a Mueller image fills only part of the one-degree bins that the Stokes camera sees.
        assert r["common"] > 0.1
    assert (folder / "campaign/campaign.png").stat().st_size > 10_000


def test_the_paper_is_compared_with_on_request(folder, configs, process):
    out = process.made("campaign", folder, *options(configs), "--paper")
    assert f"{PAPER[662].psi_deg:.2f}" in next(line for line in out.splitlines() if line.split()[:1] == ["paper"])


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def of_film(folder):
    """Means of the sample "film", by quantity."""
    rows = read(folder / "campaign/means.csv")
    return {row["quantity"]: float(row["value"]) for row in rows if row["sample"] == "film"}


@pytest.mark.long
@pytest.mark.usefixtures("figures")
def test_without_a_geometry_every_capture_has_its_means(folder, configs, process, tmp_path):
    out = process.made("campaign", folder, "--out", tmp_path / "out")
    assert [line.split()[0] for line in out.splitlines() if ".h5" in line] == ["made"] * 4
    rows = {(row["capture"], row["quantity"]): row for row in read(tmp_path / "out/means.csv")}
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    for omega in ANGLES:
        m = scene.mueller_image(omega, 662, 90, 90)[22:68, 22:68].mean(axis=(0, 1))
        for quantity, true in (("m01_over_m00", m[0, 1] / m[0, 0]), ("m11_over_m00", m[1, 1] / m[0, 0])):
            row = rows[f"drr_{omega:g}.h5", quantity]
            assert float(row["omega_deg"]) == omega
            assert float(row["low"]) < float(row["value"]) < float(row["high"])
            assert abs(float(row["value"]) - true) < 5 * float(row["u"]) + 1e-3
        assert 0 < float(rows[f"stokes_{omega:g}.h5", "dolp"]["value"]) < 0.5
    assert (tmp_path / "out/means.png").stat().st_size > 10_000
    code, out, _ = process("campaign", folder, "--out", tmp_path / "out", "--quantity", "dolp")
    assert [line.split()[0] for line in out.splitlines() if ".h5" in line] == ["unchanged"] * 4
    code, _, err = process("campaign", folder, "--out", tmp_path / "out", "--quantity", "beauty")
    assert (code, "--quantity beauty: no such quantity. There are: " in err) == (2, True)


def test_a_damaged_capture_is_reported_and_the_rest_is_made(configs, process, tmp_path):
    sound = small(tmp_path, configs, "whole", 20)
    content = sound.read_bytes()
    (tmp_path / "torn.h5").write_bytes(content[: len(content) // 2])
    with h5py.File(tmp_path / "foreign.h5", "w") as h5:
        h5["mesh"] = [1.0, 2.0]
    code, out, err = process("campaign", tmp_path)
    assert code == 2, err
    assert [line.split()[0] for line in out.splitlines() if ".mueller.h5" in line] == ["made"]
    assert "left out" in err.split("foreign.h5")[0]
    assert "torn.h5" in err.split("failed:")[1]
    assert "1 capture failed" in err
    err = process.refused("campaign", tmp_path, "--out", tmp_path / "surface", *options(configs))
    assert "torn.h5" in err.split("failed:")[1]


def test_half_of_a_geometry_and_no_scheduler_are_messages(folder, configs, process):
    code, _, err = process("campaign", folder, *options(configs)[:2])
    assert (code, "--geometry FILE and --material FILE go together" in err) == (2, True)
    assert "scheduler" in process.refused("campaign", folder, *options(configs), "--scheduler", "nonsense://x")


def small(folder, configs, name, omega, states=40, true=None, scene="white_diffuser", sample=None):
    """A small capture; fewer than 16 states determine no matrix."""
    instrument = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    bench = SimulatedBench(
        Scene.load(configs / f"scenes/{scene}.yaml"),
        true or instrument,
        662,
        rows=32,
        columns=32,
        seed=1,
        flux_e_per_s=5e5,
    )
    path = folder / f"{name}.h5"
    write_virtual_capture(path, bench, instrument, omega, states=states, darks=2, name=scene)
    if sample:
        change_header(path, sample=sample)
    return path


@pytest.mark.long
def test_the_campaigns_own_air_corrects_its_instrument(configs, process, tmp_path):
    instrument = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    azimuth = instrument.value_of("psg_retarder.azimuth_deg")
    true = instrument.with_values({"psg_retarder": {"azimuth_deg": {nm: v + 1 for nm, v in azimuth.items()}}})
    folder = tmp_path / "captures"
    folder.mkdir()
    small(folder, configs, "air", 180, true=true, scene="air", sample={"kind": "air", "name": "air"})
    small(folder, configs, "again", 180, true=true, scene="air", sample={"kind": "unknown", "name": "film"})
    process.made("campaign", folder)
    wrong = of_film(folder)
    out = process.made("campaign", folder, "--correct")
    assert "instrument of 2 captures, by 1 of air" in out
    right = of_film(folder)
    assert abs(wrong["m12_over_m00"]) > 0.02
    assert abs(right["m12_over_m00"]) < 0.002
    code, out, err = process("campaign", folder, "--correct")
    assert (code, "residual" in out, out.count("unchanged")) == (0, False, 2), err
    (folder / "air.h5").unlink()
    assert "no capture of air for --correct. Take one:" in process.refused("campaign", folder, "--correct")


@pytest.mark.usefixtures("figures")
def test_tables_compared_by_hand_give_the_campaigns_number(serial, configs, process, tmp_path):
    tables = [serial.tables[kind, 662.0] for kind in ("mueller", "stokes")]
    options = ["--geometry", configs / "geometries/one_inch_sphere.yaml", "--figure", tmp_path / "f.png"]
    out = process.made("compare-tables", *tables, *options, "--omega", "35,60", "--size", 180)
    for row in serial.rows:
        line = next(text for text in out.splitlines() if text.strip().startswith(f"{row.omega_deg:g} "))
        assert [float(v) for v in line.split()[1:]] == pytest.approx(
            [row.xi0_percent, row.xi0_noise_percent, row.xi0_systematic_percent, row.common], abs=6e-4
        )
    assert (tmp_path / "f.png").stat().st_size > 10_000
    assert "give numbers in degrees" in process.refused("compare-tables", *tables, *options, "--omega", "x")


@pytest.mark.long
def test_report_of_a_campaign_shows_its_tables_and_eigenvalues(folder, serial, process, tmp_path):
    results = serial.tables["mueller", 662.0].parent
    process.made("report", results, "--out", tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    assert "table over theta_h, theta_d, phi_d, simulated" in text
    assert "coherency eigenvalues, xi0 and its error" in text


def test_noise_of_psi_and_magnitude_explains_no_more_than_there_is(serial):
    for row in serial.rows:
        assert 0 < row.psi_noise_deg < 1.1 * row.psi_deg
        assert 0 < row.magnitude_noise_percent < 1.1 * row.magnitude_percent


@SLOW_DISC
@pytest.mark.long
def test_a_cluster_gives_the_same_numbers(folder, serial, configs, tmp_path):
    distributed = pytest.importorskip("distributed")
    files = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    # One address on loopback and no dashboard: both would look for a network.
    settings = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    settings |= {"protocol": "tcp", "host": "127.0.0.1"}
    with distributed.LocalCluster(**settings) as cluster, executor(scheduler=cluster.scheduler_address) as pool:
        in_cluster = ProcessedCampaign(folder, tmp_path, *files).run(pool)
    assert serial.rows == in_cluster.rows


@SLOW_DISC
@pytest.mark.long
def test_a_cluster_survives_a_capture_that_fails_and_a_worker_that_dies(configs, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")

    def process(*words):
        # The workers write their own tracebacks to the files of this process, which `capsys` leaves alone.
        code = exit_code(main, *words)
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return code, out, err

    for number in range(5):
        small(tmp_path, configs, f"c{number}", 20 + number, states=8 if number == 2 else 40)
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "host": "127.0.0.1"}
    with distributed.LocalCluster(**settings, protocol="tcp") as cluster:
        killed = []

        def kill():
            while not list((tmp_path / "campaign").glob("*.mueller.h5")):
                time.sleep(0.02)
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        code, out, err = process("campaign", tmp_path, "--scheduler", cluster.scheduler_address)
        killer.join()
        stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "campaign").glob("*.mueller.h5")}
        assert (code, len(stamps), killed != []) == (1, 4, True), err
        assert [line for line in err.splitlines() if line.startswith("  ") and "c2.h5" in line], err
        assert "1 capture failed. The same command makes only what is missing." in err
        assert len({row["capture"] for row in read(tmp_path / "campaign/means.csv")}) == 4
        # The capture is taken again.
        small(tmp_path, configs, "c2", 22)
        code, out, err = process("campaign", tmp_path, "--scheduler", cluster.scheduler_address)
    assert code == 0, err
    remade = [line.split()[1] for line in out.splitlines() if line.startswith("made")]
    assert remade == [str(tmp_path / "campaign/c2.mueller.h5")]
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())


@pytest.mark.long
def test_registering_finds_a_sphere_that_the_geometry_file_misses(folder, configs, process, tmp_path):
    wrong = tmp_path / "wrong.yaml"
    text = (configs / "geometries/one_inch_sphere.yaml").read_text()
    wrong.write_text(text.replace("focal_length_mm: 60", "focal_length_mm: 61.5, centre_px: [1040.0, 1200.0]"))
    material = configs / "materials/red_print.yaml"
    with executor(1) as pool:
        off = ProcessedCampaign(folder, tmp_path / "a", wrong, material).run(pool)
        registered = ProcessedCampaign(folder, tmp_path / "b", wrong, material, register=True).run(pool)
    for worse, better in zip(off.rows, registered.rows, strict=True):
        assert better.psi_deg < 0.6 * worse.psi_deg
    product = next((tmp_path / "a").glob("drr_60.mueller.h5"))
    out = process.made("register", product, "--geometry", wrong, "--out", tmp_path / "right.yaml")
    assert "radius" in out
    # 60 mm is the truth; the start value was 61.5.
    assert ViewingGeometry.load(tmp_path / "right.yaml").camera.focal_length_mm == pytest.approx(60, abs=0.8)


@pytest.mark.long
def test_tables_and_material_and_extrapolation(folder, configs, process, tmp_path):
    geometry = configs / "geometries/one_inch_sphere.yaml"
    products = []
    for omega in ANGLES:
        for kind, name in (("drr", "mueller"), ("stokes", "stokes")):
            products.append(tmp_path / f"{kind}_{omega:g}.{name}.h5")
            capture = folder / f"{kind}_{omega:g}.h5"
            assert process("reduce", capture, "--out", products[-1], "--no-figure")[0] == 0
    mueller, stokes = products[0::2], products[1::2]

    process.made("table", *mueller, "--geometry", geometry, "--out", tmp_path / "t.h5")
    table = ScatteringTable.load(tmp_path / "t.h5")
    assert table.simulated
    assert table.frames == "renderer"
    assert table.count.sum() > 4000
    assert process("table", *mueller, "--geometry", geometry, "--out", tmp_path / "t.h5", "--layout", "odd")[0] == 2

    for sources in (mueller, stokes):
        target = tmp_path / f"fit_{sources[0].stem}.yaml"
        process.made("fit-material", *sources, "--geometry", geometry, "--out", target)
        fitted = load_reflectance(target).constants[662.0]
        assert fitted.n == pytest.approx(1.3, abs=0.03)
        assert fitted.a == pytest.approx(0.17, abs=0.02)
        assert fitted.b == pytest.approx(2.0, abs=0.1)
    for files, out, message in ((stokes, target, "exists"), (products, tmp_path / "both.yaml", "kinds")):
        assert message in process.refused("fit-material", *files, "--geometry", geometry, "--out", out)

    process.made("extrapolate", stokes[0], *options(configs), "--out", tmp_path / "e.h5", "--no-figure")
    truth = Scene.load(configs / "scenes/red_sphere.yaml").mueller_image(ANGLES[0], 662, 180, 180)
    with Product(tmp_path / "e.h5") as product:
        assert product.simulated
        m, errors = (np.moveaxis(product.get(n), (0, 1), (-2, -1)) for n in ("mueller", "mueller_errors"))
        inner = (product.get("valid") > 0) & binary_erosion(truth[..., 0, 0] > 0, iterations=3)
    counts_per_unit = 1e8 * 0.02 / 100  # flux x exposure / gain
    pulls = (m - counts_per_unit * truth)[inner] / errors[inner]
    for i, j in ((0, 0), (0, 1), (1, 1), (2, 2), (3, 3)):
        assert np.median(np.abs(pulls[:, i, j])) / 0.6745 == pytest.approx(1, abs=0.15)

    process.made("quantities", tmp_path / "e.h5", "--no-figure", "--out", tmp_path / "q.h5")
    lit = truth[inner]
    expected = {
        "depolarization_index": depolarization_index(lit),
        "crossed_circular": between(lit, "left", "right") / lit[:, 0, 0],
    }
    with Product(tmp_path / "q.h5") as product:
        for name, true in expected.items():
            pull = (product.get(name)[inner] - true) / product.get(f"{name}_errors")[inner]
            assert np.median(np.abs(pull)) / 0.6745 == pytest.approx(1, abs=0.15), name


@pytest.mark.usefixtures("figures")
def test_design_recommends_vertical_light(configs, process, tmp_path):
    camera = configs / "instruments/linear_stokes.yaml"
    figure = tmp_path / "design.png"
    out = process.made("design", "--stokes", *options(configs), "--camera", camera, "--figure", figure)
    assert out.count("recommended: vertical") == 2
    assert figure.stat().st_size > 10_000
    assert process("design", *options(configs), "--camera", camera)[0] == 2


def test_what_cannot_be_a_campaign_is_refused(folder, configs, tmp_path):
    with pytest.raises(ProcessError, match="no complete capture"):
        find_captures(tmp_path)
    for name in ("drr_35.h5", "drr_60.h5"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    change_header(tmp_path / "drr_60.h5", simulated=False)
    with h5py.File(tmp_path / "drr_60.h5", "r+") as h5:
        h5["entry"].attrs["simulated"] = False
    with pytest.raises(ProcessError, match="mixes simulated"):
        find_captures(tmp_path)
    (tmp_path / "drr_60.h5").write_bytes((folder / "drr_35.h5").read_bytes())
    files = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    with executor(1) as pool, pytest.raises(ProcessError, match="are both"):
        ProcessedCampaign(tmp_path, tmp_path / "out", *files).run(pool)


def test_of_two_modes_or_samples_at_one_angle_the_user_chooses(folder, configs, process, tmp_path):
    """A campaign takes samples x modes; without a choice such a folder could not be processed at all."""
    names = {"drr_35.h5": ("drr", "red_sphere"), "fine_35.h5": ("drr_fine", "red_sphere")}
    names |= {"stokes_35.h5": ("stokes", "red_sphere"), "other_35.h5": ("stokes", "white_sphere")}
    for name, (mode, sample) in names.items():
        (tmp_path / name).write_bytes((folder / f"{'stokes' if mode == 'stokes' else 'drr'}_35.h5").read_bytes())
        change_header(tmp_path / name, mode=mode, sample={"kind": "unknown", "name": sample})
    files = options(configs)
    refused = "drr_35.h5 and fine_35.h5 are both mueller captures at 662 nm, 35 degrees, of the modes drr and drr_fine"
    code, _, err = process("campaign", tmp_path, *files)
    assert (code, refused in err, "--mode drr_fine --out FOLDER" in err) == (2, True, True), err
    code, _, err = process("campaign", tmp_path, *files, "--mode", "drr", "--mode", "stokes")
    assert (code, "of the samples white_sphere and red_sphere" in err) == (2, True), err
    code, _, err = process("campaign", tmp_path, *files, "--mode", "mosaic")
    assert (code, "no capture is of the mode 'mosaic'; there are: drr, drr_fine, stokes" in err) == (2, True), err
    choice = ("--mode", "drr", "--mode", "stokes", "--sample", "red_sphere")
    code, _, err = process("campaign", tmp_path, *files, *choice)
    assert code == 0, err
    assert "fine_35.h5: mode drr_fine, sample red_sphere; not asked for" in err
    assert "other_35.h5: mode stokes, sample white_sphere; not asked for" in err
    products = {path.name for path in (tmp_path / "campaign").glob("*.h5")}
    assert {"drr_35.mueller.h5", "stokes_35.stokes.h5"} <= products
    assert not any(name.startswith(("fine", "other")) for name in products)
