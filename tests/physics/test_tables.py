"""Scattering tables: bins, files, merging, and the pBSDF that others read."""

import struct

import h5py
import numpy as np
import pytest

from processing.geometry.frames import change_frames, cross, unit
from processing.geometry.rusinkiewicz import Angles, directions
from processing.reflectance import fresnel, pbsdf
from processing.reflectance.base import normalized_mueller
from processing.reflectance.table_axes import SHAPE, TableAxes
from processing.reflectance.tables import ScatteringTable, TableError, table_steps
from processing.storage.formats.tensor_file import TensorFileError, create_tensor_file, read_tensor_file
from processing.storage.products.provenance import Step
from simulators.conformance.reflectance import random_geometry


def random_angles(count: int, seed: int = 0) -> Angles:
    rng = np.random.default_rng(seed)
    return Angles(*rng.uniform([0, 0, -np.pi], [0.3, 0.3, np.pi], size=(count, 3)).T)


def reference(axes: TableAxes, angles: Angles, values: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Samples by bin, a pixel at a time, nearest axis value."""
    bins: dict[tuple[int, ...], list[np.ndarray]] = {}
    for n in range(values.shape[1]):
        th, td, pd = (np.rad2deg(a[n]) for a in angles)
        i = round(90 * np.sqrt(th / 90)) if axes.layout == "renderer" else round(th)
        key = (i, round(td), round(pd + 180) % 360)
        bins.setdefault(key, []).append(values[:, n])
    return {k: np.array(v) for k, v in bins.items()}


@pytest.mark.parametrize(("layout", "quantities"), [("degree", 16), ("renderer", 2)])
def test_mean_variance_and_count_equal_a_loop_over_pixels(layout, quantities):
    angles = random_angles(3000)
    values = np.random.default_rng(1).normal(3, 1, size=(quantities, 3000)).astype(np.float32)
    table = ScatteringTable(tuple(f"q{i}" for i in range(quantities)), 662, layout)
    half = 1500  # two captures
    table.add(Angles(*(a[:half] for a in angles)), values[:, :half])
    table.add(Angles(*(a[half:] for a in angles)), values[:, half:])
    expected = reference(table.axes, angles, values)
    assert len(expected) == table.bins.size
    for row, b in enumerate(table.bins):
        key = tuple(int(k) for k in np.unravel_index(b, SHAPE))
        samples = expected[key]
        assert table.count[row] == len(samples)
        np.testing.assert_allclose(table.mean[:, row], samples.mean(axis=0), rtol=1e-6)
        if len(samples) > 1:
            np.testing.assert_allclose(table.variance[:, row], samples.var(axis=0, ddof=1), rtol=1e-4, atol=1e-9)
        else:
            assert np.isnan(table.variance[:, row]).all()


def test_minus_180_and_plus_180_are_one_direction():
    table = ScatteringTable(("xi0",), 662)
    angle = np.array([0.2, 0.2])
    table.add(Angles(angle, angle, np.array([-np.pi, np.pi])), np.array([[0.4, 0.6]]))
    assert table.bins.size == 1
    np.testing.assert_allclose(table.lookup(Angles(angle, angle, np.array([np.pi, -np.pi]))), 0.5)


@pytest.mark.parametrize("layout", ["degree", "renderer"])
def test_bin_centres_fall_into_their_bins(layout):
    axes = TableAxes(layout)
    bins = np.random.default_rng(2).integers(0, SHAPE[0] * SHAPE[1], size=500) * 361 + 17
    np.testing.assert_array_equal(axes.bins(axes.angles(bins)), bins)


def test_not_a_number_and_empty_bins():
    angles = random_angles(10)
    values = np.ones((2, 10))
    values[1, 3] = np.nan
    table = ScatteringTable(("a", "b"), 662)
    table.add(angles, values)
    assert table.count.sum() == 9
    table.add(Angles(np.array([np.nan]), np.array([0.1]), np.array([0.1])), np.ones((2, 1)))
    assert table.count.sum() == 9
    far = Angles(np.array([1.5]), np.array([1.5]), np.array([0.0]))
    assert np.isnan(table.lookup(far)).all()
    assert np.isnan(ScatteringTable(("a",), 662).lookup(far)).all()


def test_file_round_trip_keeps_growing_and_merging(tmp_path):
    a, b = random_angles(400, 1), random_angles(400, 2)
    va, vb = np.random.default_rng(3).uniform(size=(2, 4, 400))
    kind = {"has_noise": True, "inputs": ("polarizer", "analyzer")}
    table, part, second = (ScatteringTable(("xi0",), 451, "renderer", True, **kind) for _ in range(3))
    table.add(a, va)
    table.add(b, vb)
    part.add(a, va)
    second.add(b, vb)
    part.save(tmp_path / "t.h5")
    loaded = ScatteringTable.load(tmp_path / "t.h5")
    loaded.merge(second)
    assert (loaded.wavelength_nm, loaded.axes.layout, loaded.simulated) == (451, "renderer", True)
    probe = random_angles(500, 4)
    np.testing.assert_allclose(loaded.lookup(probe), table.lookup(probe))
    for name, values in table.uncertainties.items():
        np.testing.assert_allclose(loaded.uncertainties[name], values)
    with h5py.File(tmp_path / "t.h5") as h5:
        np.testing.assert_allclose(h5["entry/sums/theta_h_deg"][...], 90 * (np.arange(91) / 90) ** 2)


@pytest.mark.parametrize("version", [1, 2])
def test_a_table_of_an_earlier_version_is_read(tmp_path, version):
    """Variance and directions were quantities; the first had all arrays in the root."""
    names, values = ("xi0", "xi0_variance", "xi0_direction_0_analyzer"), np.random.default_rng(3).uniform(size=(3, 400))
    table = ScatteringTable(("xi0",), 451, "renderer", True, has_noise=True, inputs=("analyzer",))
    earlier = ScatteringTable(names, 451, "renderer", True)
    for each in (table, earlier):
        each.add(random_angles(400, 1), values)
    earlier.save(tmp_path / "t.h5", steps=[Step("table", {})])
    with h5py.File(tmp_path / "t.h5", "r+") as h5:
        h5.attrs["umov_table"] = version
        if version == 1:
            for name in ("data/bin", "data/count", "sums/sum", "sums/sum_of_squares", "sums/theta_h_deg", "process_1"):
                h5.copy(f"entry/{name}", h5, name.split("/")[-1])
            del h5["entry"]
    loaded = ScatteringTable.load(tmp_path / "t.h5")
    assert (loaded.quantities, loaded.inputs) == (("xi0",), ("analyzer",))
    for array, expected in ((loaded.mean, table.mean), (loaded.variance, table.variance)):
        np.testing.assert_array_equal(array, expected)
    for name in ("u_noise", "u_systematic"):
        np.testing.assert_array_equal(loaded.uncertainties[name], table.uncertainties[name])
    assert [step.name for step in table_steps(tmp_path / "t.h5")] == ["table"]
    with h5py.File(tmp_path / "t.h5", "r+") as h5:
        h5.attrs["umov_table"] = 4
    with pytest.raises(TableError, match="table version 4; this program reads up to 3"):
        ScatteringTable.load(tmp_path / "t.h5")


def test_what_does_not_belong_together_is_refused(tmp_path):
    table = ScatteringTable(("xi0",), 662)
    with pytest.raises(TableError, match="never mixed"):
        table.add(random_angles(2), np.ones((1, 2)), simulated=True)
    with pytest.raises(TableError, match="shape"):
        table.add(random_angles(2), np.ones((3, 2)))
    with pytest.raises(TableError, match="cannot be merged"):
        table.merge(ScatteringTable(("xi0",), 451))
    (tmp_path / "no.h5").write_text("no")
    with pytest.raises(TableError, match="cannot be opened as HDF5"):
        ScatteringTable.load(tmp_path / "no.h5")


def test_a_dataset_in_place_of_a_group_is_not_read_from_end_to_end(tmp_path):
    table = ScatteringTable(("xi0",), 662)
    table.add(Angles(*(np.array([0.3]) for _ in range(3))), np.array([[0.5]]))
    table.save(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "r+") as h5:
        del h5["entry/data"]
        h5.create_dataset("entry/data", (1 << 40,), chunks=(16,), dtype="f4")
    with pytest.raises(TableError, match="no group entry/data"):
        ScatteringTable.load(tmp_path / "t.h5")


def test_in_renderer_frames_first_surface_reflection_is_a_plain_fresnel_matrix():
    # In (s, p) axes of both beams F is diag(r_s, r_p), whatever the pixel: no fixed turn of all pixels does that.
    g = random_geometry(200)
    m = change_frames(normalized_mueller(fresnel.jones(g, 1.5 + 0.3j)), g, g.half)
    rs, rp = fresnel.amplitudes(1.5 + 0.3j, g.angles.theta_d)
    s, p = np.abs(rs) ** 2, np.abs(rp) ** 2
    np.testing.assert_allclose(m[:, 0, 1], (s - p) / (s + p), atol=1e-10)
    np.testing.assert_allclose(m[:, 1, 0], (s - p) / (s + p), atol=1e-10)
    np.testing.assert_allclose(m[:, [0, 0, 1, 2], [2, 3, 2, 1]], 0, atol=1e-9)
    x_in = g.with_up(g.half).axes_in[0]
    np.testing.assert_allclose(np.abs(np.sum(x_in * unit(cross(g.to_source, g.to_camera)), axis=1)), 1, atol=1e-9)


def test_cosines_of_bins_equal_those_of_vectors():
    angles, cos_i, cos_o = pbsdf.bin_centres()
    some = tuple(np.random.default_rng(1).integers(0, n, size=50) for n in (91, 91, 361))
    n, wi, wo = directions(*(a[some] for a in angles))
    np.testing.assert_allclose(cos_i[some], np.sum(n * wi, axis=1), atol=1e-12)
    np.testing.assert_allclose(cos_o[some], np.sum(n * wo, axis=1), atol=1e-12)


def test_bytes_of_a_tensor_file(tmp_path):
    path = tmp_path / "t.bin"
    fields = create_tensor_file(path, {"ab": ((2,), np.uint16), "M": ((1, 3), np.float32)})
    fields["ab"][...] = [7, 9]
    fields["M"][...] = [[1.5, 2.5, 3.5]]
    for f in fields.values():
        f.flush()
    raw = path.read_bytes()
    assert raw[:18] == b"tensor_file\0" + bytes([1, 0]) + struct.pack("<I", 2)
    assert raw[18:25] == struct.pack("<H2sHB", 2, b"ab", 1, 3)
    assert raw[33:41] == struct.pack("<Q", 2)
    (offset,) = struct.unpack("<Q", raw[25:33])
    assert np.frombuffer(raw[offset : offset + 4], "<u2").tolist() == [7, 9]
    assert raw.endswith(np.float32([1.5, 2.5, 3.5]).tobytes())
    back = read_tensor_file(path)
    np.testing.assert_array_equal(back["M"], [[1.5, 2.5, 3.5]])


def test_damaged_tensor_files_are_refused(tmp_path):
    path = tmp_path / "t.bin"
    path.write_bytes(b"something else altogether")
    with pytest.raises(TensorFileError, match="no tensor file"):
        read_tensor_file(path)
    create_tensor_file(path, {"M": ((100,), np.float64)})
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(TensorFileError, match="truncated"):
        read_tensor_file(path)
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(TensorFileError, match="damaged"):
        read_tensor_file(path)
    create_tensor_file(path, {"x": ((1,), np.uint8)})
    with pytest.raises(TableError, match="lacks"):
        pbsdf.load(path)


def mueller_table(angles: Angles, values: np.ndarray) -> ScatteringTable:
    table = ScatteringTable(pbsdf.MUELLER, 662, "renderer", frames="renderer")
    table.add(angles, values)
    return table


def test_export_and_import_give_the_filled_bins_back(tmp_path):
    rng = np.random.default_rng(3)
    angles = Angles(*rng.uniform([0, 0, -np.pi], [0.8, 0.6, np.pi], size=(2000, 3)).T)
    values = rng.normal(size=(16, 2000))
    table = mueller_table(angles, values)
    missing = pbsdf.export([table], tmp_path / "m.pbsdf", empty="nan", pad_wavelengths=False)
    assert missing > 0.99
    fields = read_tensor_file(tmp_path / "m.pbsdf")
    assert fields["M"].shape == (361, 91, 91, 1, 4, 4)
    assert fields["M"].dtype == np.float32
    assert fields["wvls"].dtype == np.uint16
    np.testing.assert_array_equal(fields["M"][0], fields["M"][360])
    back = pbsdf.load(tmp_path / "m.pbsdf")[662]
    assert set(back.bins) == set(table.bins)
    centre = table.axes.angles(table.bins)
    np.testing.assert_allclose(back.lookup(centre), table.lookup(centre), rtol=2e-6, atol=1e-6)


def test_empty_bins_take_the_nearest_value_around_the_circle():
    angles = np.deg2rad([[10.0, 20.0, 179.0], [10.0, 20.0, 0.0]]).T
    table = mueller_table(Angles(*angles), np.stack([np.full(16, 1.0), np.full(16, 2.0)], axis=-1))
    dense, gaps = pbsdf.fill_bins(table, table.mean, 1.0, "nearest")
    _, cos_i, _ = pbsdf.bin_centres()
    i, j = round(90 * np.sqrt(10 / 90)), 20
    values = dense[:, j, i, 0, 0] * np.pi * cos_i[i, j]
    assert 0.999 < gaps < 1
    # phi_d = -170 is 11 degrees from 179, the other way round.
    assert values[[10, 180, 350, 0, 360]] == pytest.approx([1, 2, 1, 1, 1])
    assert np.isnan(dense[0, 90, 45]).all()


def test_the_uncertainty_of_each_element_is_exported_where_there_are_samples(tmp_path):
    table = ScatteringTable(pbsdf.MUELLER, 662, "renderer", frames="renderer", has_noise=True, inputs=("analyzer",))
    direction = Angles(np.array([0.0]), np.array([0.0]), np.array([0.0]))
    table.add(direction, np.repeat([1.0, 0.03**2, 0.04], 16)[:, None])
    pbsdf.export([table], tmp_path / "m.pbsdf", white_m00=2.0, uncertainty=True, pad_wavelengths=False)
    fields = read_tensor_file(tmp_path / "m.pbsdf")
    assert fields["u"][180, 0, 0, 0] * 2 * np.pi == pytest.approx(np.full((4, 4), 0.05))
    assert np.isfinite(fields["u"]).sum() == 16
    assert np.isfinite(fields["M"]).sum() > 1e6
    with pytest.raises(TableError, match="does not know its noise"):
        pbsdf.export([mueller_table(direction, np.ones((16, 1)))], tmp_path / "n.pbsdf", uncertainty=True)


def test_only_what_the_renderer_expects_is_exported(tmp_path):
    angles = Angles(np.array([0.1]), np.array([0.1]), np.array([0.1]))
    table = ScatteringTable(pbsdf.MUELLER, 662, "degree", frames="renderer")
    table.add(angles, np.ones((16, 1)))
    with pytest.raises(TableError, match="layout"):
        pbsdf.export([table], tmp_path / "x.pbsdf")
    with pytest.raises(TableError, match="empty"):
        pbsdf.export([ScatteringTable(pbsdf.MUELLER, 662, "renderer", frames="renderer")], tmp_path / "x.pbsdf")
