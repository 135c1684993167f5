"""Coherency eigenvalues, depolarization and reciprocity of measured PTFE: the numbers of docs/studies/ptfe.md."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from processing.polarization import mueller, quantities
from processing.polarization.cloude import coherency_eigenvalues

pytestmark = pytest.mark.measured

#: um: median xi0, median and 95 % of the light that the TD model misses, median depolarization index.
FOUND = {
    0.351: (0.272, 0.0104, 0.0278, 0.034),
    0.532: (0.273, 0.0096, 0.0163, 0.034),
    0.633: (0.275, 0.0112, 0.0185, 0.038),
    1.064: (0.279, 0.0160, 0.0285, 0.048),
}


@pytest.fixture(scope="module")
def report() -> SimpleNamespace:
    """The functions of the script that writes the tables of docs/studies/ptfe.md."""
    return SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "benchmarks/ptfe_quantities.py")))


@pytest.fixture(scope="module")
def table(public_files) -> np.ndarray:
    rows = np.genfromtxt(public_files("ptfe-mueller-brdf")["PTFE.data.csv"], delimiter=",", skip_header=1)
    assert rows.shape == (7296, 21)
    return rows


@pytest.mark.parametrize("um", FOUND)
def test_eigenvalues_over_all_geometries(report: SimpleNamespace, table: np.ndarray, um: float) -> None:
    m, *_ = report.load(table, um)
    assert len(m) == 1824
    xi = coherency_eigenvalues(m)
    h = mueller.coherency(m)
    np.testing.assert_allclose(xi, np.linalg.eigvalsh(h / 2)[:, ::-1], atol=1e-13)
    missed, di = quantities.td_missed(xi), quantities.depolarization_index(m)
    xi0, median, high, index = FOUND[um]
    assert np.median(xi[:, 0]) == pytest.approx(xi0, abs=0.001)
    assert np.percentile(missed, [50, 95]) == pytest.approx([median, high], abs=0.0002)
    assert np.median(di) == pytest.approx(index, abs=0.001)
    assert (xi[:, 3] > 0).all()  # every measured matrix is physical
    # The index splits into the TD part and the deviation, exactly.
    squared = ((4 * xi[:, 0] - 1) / 3) ** 2 + 4 / 3 * report.squared_deviation(xi)
    np.testing.assert_allclose(di**2, squared, atol=1e-14)
    # None of this depends on the axes of the file.
    raw = np.concatenate([np.ones((1824, 1)), table[table[:, 0] == um][:, 6:]], axis=1).reshape(-1, 4, 4)
    np.testing.assert_allclose(coherency_eigenvalues(raw), xi, atol=1e-12)


def test_the_picture_of_the_page(report: SimpleNamespace, table: np.ndarray, tmp_path: Path) -> None:
    report.figure(table, tmp_path / "made.png")
    page = Path(__file__).parents[2] / "docs/images/ptfe_quantities.png"
    made, shown = (cv2.imread(str(path)).astype(int) for path in (tmp_path / "made.png", page))
    # Fonts differ a little from one version of the drawing library to the next, curves do not.
    assert np.abs(made - shown).mean() < 1


@pytest.mark.parametrize("um", FOUND)
def test_what_the_triply_degenerate_model_misses_beyond_noise(
    report: SimpleNamespace, table: np.ndarray, um: float
) -> None:
    m, _, *geometry = report.load(table, um)
    sigma = report.noise_of_elements(m, *geometry)
    fakes = [coherency_eigenvalues(report.triply_degenerate_with_noise(m, sigma, seed)) for seed in range(40)]
    measured = report.squared_deviation(coherency_eigenvalues(m)).mean()
    noise = np.mean([report.squared_deviation(xi).mean() for xi in fakes])
    true = np.sqrt((measured - noise) / 3)
    assert 0.0035 < true < 0.006  # about half a per cent of the light at all four wavelengths


@pytest.mark.parametrize("um", FOUND)
def test_reciprocity(report: SimpleNamespace, table: np.ndarray, um: float) -> None:
    m, brdf, *geometry = report.load(table, um)
    distance, row = report.partner(*geometry, reverse=True)
    pair = (distance < 1.5) & (row != np.arange(len(m))) & (geometry[0] > 5) & (geometry[1] > 5)
    assert pair.sum() == 64
    assert np.std(np.log(brdf[pair] / brdf[row[pair]])) < 0.02
    back = np.swapaxes(m[row[pair]], 1, 2)

    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt(np.mean(difference.reshape(-1, 16)[:, 1:] ** 2)))

    reciprocal = rms(m[pair] - report.RECIPROCAL @ back @ report.RECIPROCAL)
    noise = np.sqrt(2 * np.mean(report.noise_of_elements(m, *geometry)[pair] ** 2))
    assert reciprocal < 1.1 * noise
    for other in (np.eye(4), np.diag([1.0, 1.0, -1.0, -1.0]), np.diag([1.0, 1.0, 1.0, -1.0])):
        assert rms(m[pair] - other @ back @ other) > 1.25 * reciprocal
    assert rms(m[pair] - m[row[pair]]) > 1.25 * reciprocal
    # In the file's own axes of the reflected beam it does not hold.
    raw = np.concatenate([np.ones((1824, 1)), table[table[:, 0] == um][:, 6:]], axis=1).reshape(-1, 4, 4)
    unturned = raw[pair] - report.RECIPROCAL @ np.swapaxes(raw[row[pair]], 1, 2) @ report.RECIPROCAL
    assert rms(unturned) > 1.25 * reciprocal
