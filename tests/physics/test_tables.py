"""Tables over scattering geometry."""

import h5py
import numpy as np
import pytest

from processing.geometry.rusinkiewicz import Angles
from processing.reflectance.table_axes import SHAPE, TableAxes
from processing.reflectance.tables import ScatteringTable, TableError, table_steps
from processing.storage.products.provenance import Step


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


@pytest.mark.parametrize("layout", ["degree", "renderer"])
@pytest.mark.parametrize("quantities", [1, 2, 5, 16])
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
