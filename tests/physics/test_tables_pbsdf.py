"""The renderer's file: layout of bytes, frames of every pixel, and the way there and back."""

import struct

import numpy as np
import pytest

from processing.geometry.frames import change_frames, cross, unit
from processing.geometry.rusinkiewicz import Angles, directions
from processing.reflectance import fresnel, pbsdf
from processing.reflectance.base import normalized_mueller
from processing.reflectance.tables import ScatteringTable, TableError
from processing.storage.formats.tensor_file import TensorFileError, create_tensor_file, read_tensor_file
from simulators.conformance.reflectance import random_geometry


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
    got = dense[:, j, i, 0, 0] * np.pi * cos_i[i, j]
    assert 0.999 < gaps < 1
    # phi_d = -170 is 11 degrees from 179, the other way round.
    assert got[[10, 180, 350, 0, 360]] == pytest.approx([1, 2, 1, 1, 1])
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
