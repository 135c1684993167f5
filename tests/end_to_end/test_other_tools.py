"""Captures and products open in tools that nobody here wrote: named dimensions, units, the default plot of NeXus."""

import importlib
import re
from pathlib import Path

import h5py
import numpy as np
import pandas
import pytest
import xarray as xr

from acquisition.capture.state_file import StateFile
from processing.commands.application import main
from processing.export import export
from processing.geometry.rusinkiewicz import Angles
from processing.labelled import open_dataset
from processing.reflectance.tables import ScatteringTable
from processing.steps.maps import Xi0
from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Plane, Product
from processing.storage.products.product_writer import ProductWriter
from tests.commands import exit_code

DOCS = Path(__file__).parents[2] / "docs"
STATES, SHAPE = 24, (6, 8)


@pytest.fixture
def capture(synthetic_capture, configs, tmp_path) -> Path:
    (tmp_path / "captures").mkdir()
    psg = np.arange(STATES) * 7.5  # over one half turn, not commensurate with the analyzer
    text = (configs / "instruments" / "drr_5to1.yaml").read_text()
    frames = np.random.default_rng(3).integers(400, 3000, (STATES, 1, *SHAPE), dtype=np.uint16)
    detector = {"gain_e_per_count": 2.5, "read_noise_e": 4.0, "bits": 12}
    angles = {"psg": psg, "psa": psg * 4.91, "arm": np.full(STATES, 35.0)}
    path = synthetic_capture(frames, angles, instrument_yaml=text, detector=detector)
    # Where the lines of the docs look for it.
    return path.rename(path.parent / "captures" / "drr_omega35.h5")


#: The product of that capture, made once.
MADE: dict[str, bytes] = {}


@pytest.fixture
def product(capture) -> Path:
    path = capture.with_suffix(".mueller.h5")
    if not MADE:
        MADE["mueller"] = Reduction(capture).make(path).read_bytes()
    path.write_bytes(MADE["mueller"])
    return path


@pytest.fixture
def table(tmp_path):
    rng = np.random.default_rng(5)
    inputs = ("psg_retarder.retardance_deg", "analyzer.azimuth_deg")
    bins = ScatteringTable(("xi0",), 662, "renderer", simulated=True, has_noise=True, inputs=inputs)
    angles = Angles(*(rng.uniform(0, most, 400) for most in (0.5, 1.2, 3.0)))
    bins.add(angles, rng.normal(0.8, 0.05, (4, 400)))
    bins.add(Angles(*(angle[:200] for angle in angles)), rng.normal(0.8, 0.05, (4, 200)))
    bins.save(tmp_path / "table.h5")
    return tmp_path / "table.h5"


def test_the_lines_in_the_docs_open_both_with_xarray(capture, product, monkeypatch):
    code = re.search(r"```python\n(.*?)```", (DOCS / "other-tools.md").read_text(), re.DOTALL)
    monkeypatch.chdir(capture.parents[1])
    names: dict = {}
    exec(code[1], names)
    frames, image = names["frames"], names["image"]
    with frames, image:
        assert frames["data"].dims == ("state", "channel", "y", "x")
        dataset = open_dataset(capture)
        np.testing.assert_array_equal(frames["data"], dataset["counts"])
        for name in ("psg_deg", "psa_deg", "arm_deg", "exposure_s"):
            assert name in frames["data"].coords
            np.testing.assert_array_equal(frames[name], dataset[name])
        assert image["mueller"].dims == open_dataset(product)["mueller"].dims == ("row", "column", "y", "x")
        np.testing.assert_array_equal(image["mueller_errors"], MuellerImage.load(product).errors)
        assert not [name for name in (*frames.dims, *image.dims) if name.startswith("phony")]


def test_xarray_sees_the_bins_of_a_scattering_table(table):
    stored = ScatteringTable.load(table)
    with xr.open_dataset(table, engine="h5netcdf", group="entry/data") as bins:
        assert bins["mean"].dims == ("quantity", "bin")
        assert [*bins["quantity_name"].values.astype(str)] == list(stored.quantities)
        np.testing.assert_array_equal(bins["mean"], stored.mean)
        np.testing.assert_array_equal(bins["sample_variance"], stored.variance)
        assert bins["directions"].dims == ("input", "quantity", "bin")
        assert [*bins["input_name"].values.astype(str)] == list(stored.inputs)
        for name, values in stored.uncertainties.items():
            assert bins[name].dtype == np.float32
            np.testing.assert_allclose(bins[name], values, rtol=1e-6)
        np.testing.assert_array_equal(bins["bin"], stored.bins)
        at = Angles(*(np.deg2rad(bins[name].values) for name in ("theta_h_deg", "theta_d_deg", "phi_d_deg")))
        np.testing.assert_array_equal(stored.axes.bins(at), stored.bins)
        assert set(bins["mean"].coords) >= {"theta_h_deg", "theta_d_deg", "phi_d_deg", "count", "quantity_name"}


def test_a_product_of_an_earlier_version_has_its_flags(product):
    with h5py.File(product, "r+") as h5:
        h5.move("entry/data/pixel_flags", "entry/data/pixel_mask")
    with Product(product) as read:
        assert "pixel_flags" in read.names
        assert "bits" in read.long_name("pixel_flags")
        assert read.units("pixel_flags") == ""
    assert not MuellerImage.load(product).mask.any()


def test_a_whole_capture_is_a_tree_for_xarray(capture):
    with xr.open_datatree(capture, engine="h5netcdf") as tree:
        assert tree["entry/states/exposure_s"].dims == tree["entry/instrument/psg/value"].dims == ("state",)
        assert tree["entry/instrument/detector/row_crc32"].dims == ("state", "channel", "y")


def test_a_whole_product_is_a_tree_for_xarray_with_names_for_all_dimensions(product):
    with xr.open_datatree(product, engine="h5netcdf") as tree:
        dims = {dim for node in tree.subtree for dim in node.ds.dims}
        assert "measurement_matrix_axis_0" in dims
        assert not [dim for dim in dims if str(dim).startswith("phony")]
        np.testing.assert_array_equal(
            tree["entry/reduction/measurement_matrix"], Product(product).array("measurement_matrix")
        )


def test_dask_chooses_chunks_of_every_file(capture, product, table):
    """Text of any length is an object to numpy, whose size dask cannot tell."""
    for path in (capture, product, table):
        with xr.open_datatree(path, engine="h5netcdf", chunks="auto") as tree:
            assert any(array.chunks for node in tree.subtree for array in node.ds.values())
            assert not [d for node in tree.subtree for d in node.ds.dims if str(d).startswith("phony")]


def test_the_default_plot_has_its_axes_and_coordinates(capture, product, table):
    for path in (capture, product, table):
        with h5py.File(path) as h5:
            entry = h5[h5.attrs["default"]]
            data = entry[entry.attrs["default"]]
            assert data.attrs["NX_class"] == "NXdata"
            signal = data[data.attrs["signal"]]
            axes = list(data.attrs["axes"])
            assert tuple(len(data[name]) for name in axes) == signal.shape
            for name in (key.removesuffix("_indices") for key in data.attrs if key.endswith("_indices")):
                assert len(data[name]) == signal.shape[data.attrs[f"{name}_indices"]]


def test_every_number_has_units_and_every_error_its_value(capture, product, table):
    for path in (capture, product, table):
        missing, errors = [], []

        def look(name: str, node: object, missing: list = missing, errors: list = errors) -> None:
            if isinstance(node, h5py.Dataset):
                if node.dtype.kind in "uif" and "units" not in node.attrs and not name.endswith("sequence_index"):
                    missing.append(name)
                if name.endswith("_errors"):
                    errors.append(node.shape == node.parent[node.name.removesuffix("_errors")].shape)

        with h5py.File(path) as h5:
            h5.visititems(look)
        assert missing == []
        assert all(errors)


def test_a_file_with_the_older_layout_is_read_and_written_in_its_place(capture):
    """Before named dimensions the journal and the closing record were arrays of bytes."""
    with h5py.File(capture, "r+") as h5:
        for name, size in (("segments", 4096), ("closing", 2048)):
            h5["entry"].pop(name, None)
            h5[f"entry/{name}/json"] = np.zeros(size, np.uint8)
        for name in ("definition", "state", "channel", "y", "x", "data"):
            del h5[f"entry/{name}"]
        h5["entry"].attrs["status_at"] = 0
    file = StateFile(capture)
    file.add_segment_record({"event": "begin"})
    file.write_closing({"end_time": "now"})
    file.close()
    with Capture(capture) as reader:
        assert reader.closing == {"end_time": "now"}
        assert len(reader.frames(3)[0]) == SHAPE[0]


def test_xarray_is_shown_the_records_as_they_are(capture):
    """In a file that was imported and cannot be gone on with there is no room behind them either."""
    with h5py.File(capture) as h5:
        text = h5["entry/closing/json"]
        assert text.id.get_storage_size() == text.dtype.itemsize == len(text[()])
        written = text[()]
    with xr.open_dataset(capture, engine="h5netcdf", group="entry/closing") as closing:
        assert closing["json"].item() == written


def test_compressed_planes_are_plain_deflate_and_read_the_same(tmp_path):
    """What h5py and MATLAB know without plug-ins; a plane of noise stays as it is, and so does a whole file of it."""
    rng = np.random.default_rng(5)
    planes = {
        "valid": Plane((), "", "mostly the same", np.uint8),
        "noise": Plane((2,), "", "incompressible", np.float32),
        "spread": Plane((3,), "", "zero but for some", np.float32),
    }
    shape = (301, 501)
    values = {
        "valid": (rng.random(shape) < 0.99).astype(np.uint8),
        "noise": rng.normal(size=(2, *shape)).astype(np.float32),
        "spread": np.where(rng.random((3, *shape)) < 0.1, 1.5, np.nan).astype(np.float32),
    }
    path = tmp_path / "p.h5"
    header = CaptureHeader(title="t", simulated=True, mode="drr", wavelength_nm=600)
    with ProductWriter(path, "xi0", header, shape, planes=planes, steps=()) as writer:
        writer.write(slice(0, shape[0]), **values)
        writer.seal({"rank": 16})
    with h5py.File(path) as h5:
        filters = {name: h5[f"entry/data/{name}"].compression for name in planes}
        assert filters == {"valid": "gzip", "noise": None, "spread": "gzip"}
        for name in planes:
            np.testing.assert_array_equal(h5[f"entry/data/{name}"][...], values[name])
    assert path.stat().st_size < 0.7 * sum(array.nbytes for array in values.values())
    with Product(path) as product:
        assert product.facts == {"rank": 16}
        np.testing.assert_array_equal(product.get("spread", slice(100, 111)), values["spread"][:, 100:111])
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture
def exported(product, capture, tmp_path, capsys):
    """Runs `process export`; the files it names."""

    def run(source: str, *options: str) -> list[Path]:
        capsys.readouterr()
        file = {"product": product, "capture": capture}[source]
        assert exit_code(main, "export", file, "--out", f"{tmp_path}/e", *options) == 0, capsys.readouterr().err
        return [Path(line) for line in capsys.readouterr().out.split()]

    return run


def test_exported_numbers_are_the_same(exported, product, capture):
    from astropy.io import fits
    from PIL import Image
    from scipy.io import loadmat

    image, counts = open_dataset(product), open_dataset(capture)
    mueller = image["mueller"].values
    with Image.open(exported("product", "--to", "tiff", "--plane", "mueller")[0]) as tiff:
        assert tiff.n_frames == 16
        tiff.seek(6)
        np.testing.assert_array_equal(np.asarray(tiff), mueller[1, 2])
        assert "row 1, column 2" in tiff.tag_v2[270]
    with Image.open(exported("capture", "--to", "tiff")[0]) as tiff:
        tiff.seek(5)
        np.testing.assert_array_equal(np.asarray(tiff), counts["counts"].values[5, 0])
    mat = loadmat(exported("product", "--to", "mat")[0])
    np.testing.assert_array_equal(mat["mueller"], mueller)
    assert mat["units"]["mueller"][0, 0][0] == "count"
    assert mat["about"]["simulated"][0, 0][0, 0] == 1
    with fits.open(exported("capture", "--to", "fits")[0]) as hdus:
        np.testing.assert_array_equal(hdus["counts"].data, counts["counts"].values)
        np.testing.assert_array_equal(hdus["states"].data["psg_deg"], counts["psg_deg"].values)
        assert hdus["counts"].header["BUNIT"] == "count"


def test_exported_tables_read_back_exactly(exported, product, capture):
    pixels = pandas.read_csv(exported("product", "--to", "csv")[0], comment="#")
    image = open_dataset(product)
    np.testing.assert_array_equal(pixels["mueller_1_2"].to_numpy(np.float32), image["mueller"].values[1, 2].ravel())
    np.testing.assert_array_equal(pixels["y"].to_numpy().reshape(SHAPE)[3], 3)
    path = exported("capture", "--to", "csv", "--overwrite")[0]
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == 1 + STATES
    assert "# simulated: 1" in path.read_text()
    at = lines[0].split(",").index("psa_deg")
    assert [float(line.split(",")[at]) for line in lines[1:]] == list(open_dataset(capture)["psa_deg"].values)


@pytest.mark.parametrize("to", ["csv", "mat", "fits", "tiff"])
def test_noise_and_the_instruments_part_leave_with_their_names(capture, configs, tmp_path, to):
    """In every format, and in the arrays of a notebook; of xi0 with what is uncertain."""
    from astropy.io import fits
    from scipy.io import loadmat

    text = (configs / "instruments/drr_5to1.yaml").read_text()
    stated = tmp_path / "stated.yaml"
    stated.write_text(re.sub(r"retardance_deg: ([0-9.]+)", r"retardance_deg: {value: \1, u: 0.3}", text))
    product = Xi0(Reduction(capture, stated).make(tmp_path / "m.mueller.h5")).make()
    names, dataset = ["xi0_errors", "xi0_systematic"], open_dataset(product)
    assert "retardance_deg" in dataset.attrs["uncertain_in_the_instrument"]
    files = export(product, to, tmp_path / "x", names)
    if to == "csv":
        read = pandas.read_csv(files[0], comment="#")
        assert "retardance_deg" in files[0].read_text()
    elif to == "mat":
        read = {name: values.ravel() for name, values in loadmat(files[0]).items() if name in names}
    elif to == "fits":
        with fits.open(files[0]) as hdus:
            read = {name: hdus[name].data.ravel() for name in names}
    else:
        assert [path.name for path in files] == [f"x.{name}.tif" for name in names]
        return
    for name in names:
        np.testing.assert_array_equal(
            np.asarray(read[name], np.float32), dataset[name].values.ravel().astype(np.float32)
        )


def test_an_exported_scattering_table_reads_back_exactly(tmp_path, table, capsys):
    table = ScatteringTable.load(table)
    assert exit_code(main, "export", tmp_path / "table.h5", "--to", "csv") == 0
    path = tmp_path / "table.csv"
    assert capsys.readouterr().out.split() == [str(path)]
    assert "# simulated: True\n" in path.read_text()
    read = pandas.read_csv(path, comment="#")
    assert [*read.columns] == [
        "theta_h_deg", "theta_d_deg", "phi_d_deg", "samples",
        "xi0", "xi0_u_noise", "xi0_u_systematic", "xi0_sample_variance",
    ]  # fmt: skip
    angles = Angles(*(np.deg2rad(read[name]) for name in ("theta_h_deg", "theta_d_deg", "phi_d_deg")))
    assert len(read) == table.bins.size
    np.testing.assert_array_equal(table.counts(angles), read["samples"])
    np.testing.assert_array_equal(table.lookup(angles)[0], read["xi0"])
    order = np.argsort(table.bins)
    for name, values in table.uncertainties.items():
        np.testing.assert_array_equal(values[0, order], read[f"xi0_{name}"])
    np.testing.assert_array_equal(table.variance[:, order][0], read["xi0_sample_variance"])

    assert exit_code(main, "export", tmp_path / "table.h5", "--to", "csv", "--plane", "xi1", "--overwrite") == 2
    assert "has no 'xi1'; it has: xi0" in capsys.readouterr().err
    assert exit_code(main, "export", tmp_path / "table.h5", "--to", "fits") == 2
    assert "is a scattering table: it goes into csv" in capsys.readouterr().err


def test_exported_maps_have_the_colours_of_the_reports(exported, monkeypatch):
    from matplotlib.figure import Figure

    from processing.reports import figure_style

    # Imported by a later test, this module would keep the function of this one.
    importlib.import_module("processing.reports.figures")
    drawn = []
    monkeypatch.setattr(figure_style, "grid_figure", lambda panels, *_: drawn.extend(panels) or Figure())
    exported("product", "--to", "png", "--plane", "mueller", "--plane", "mueller_errors")
    assert [keywords["cmap"] for _, _, keywords in drawn] == ["RdBu_r"] * 16 + ["magma"] * 16
    assert all(keywords["vmin"] == -keywords["vmax"] for _, _, keywords in drawn[:16])
    assert drawn[6][0] == "mueller 12 (count)"


@pytest.mark.parametrize(("outlier", "arrow"), [(-1.0, "min"), (1.0, "max"), (0.0, "neither")])
def test_the_colour_bar_of_a_mueller_image_has_an_arrow_where_values_lie_beyond_it(outlier, arrow):
    from processing.reports.figures import mueller_figure

    elements = np.zeros((4, 4, 20, 30))
    elements[0, 0], elements[1, 1, 3, 4] = 1.0, outlier
    elements[2, 2] = 0.1
    figure = mueller_figure(elements, np.ones((20, 30), dtype=bool), "one pixel", simulated=True)
    bars = [axis._colorbar for axis in figure.axes if hasattr(axis, "_colorbar")]
    assert [bar.extend for bar in bars] == [arrow]


@pytest.mark.long
def test_a_mueller_image_alone_is_exported_as_its_own_figure(exported, tmp_path):
    (alone,) = exported("product", "--to", "png", "--plane", "mueller", "--out", f"{tmp_path}/alone.png")
    assert alone.name == "alone.png"
    (figure,) = exported("product", "--to", "png", "--out", f"{tmp_path}/whole")
    assert alone.read_bytes() == figure.read_bytes()


@pytest.mark.long
def test_figures_are_written_and_nothing_is_replaced(exported, product, tmp_path, capsys):
    path = exported("product", "--to", "pdf", "--plane", "mueller_errors")[0]
    assert path.read_bytes().startswith(b"%PDF")
    for options, message in (
        (["--to", "pdf", "--plane", "mueller"], "exists"),
        (["--to", "doc"], "unknown format"),
        (["--to", "nexus"], "is a NeXus file (HDF5) already"),
        (["--to", "csv", "--plane", "nothing"], "has no 'nothing'"),
    ):
        assert exit_code(main, "export", product, "--out", f"{tmp_path}/e", *options) == 2
        assert message in capsys.readouterr().err
