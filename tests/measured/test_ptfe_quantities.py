"""Coherency eigenvalues, depolarization and reciprocity of measured PTFE: the numbers of docs/studies/ptfe.md."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.arrays import Array
from processing.polarization import mueller, quantities, triply_degenerate
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from tests.measured.ptfe import in_surface_axes

pytestmark = pytest.mark.measured

#: um: median xi0, median and 95 % of the light that the TD model misses, median depolarization index.
FOUND = {
    0.351: (0.272, 0.0104, 0.0278, 0.034),
    0.532: (0.273, 0.0096, 0.0163, 0.034),
    0.633: (0.275, 0.0112, 0.0185, 0.038),
    1.064: (0.279, 0.0160, 0.0285, 0.048),
}


MIRROR = np.diag([1.0, 1.0, -1.0, -1.0])
#: M of the reversed path is RECIPROCAL M^T RECIPROCAL, with x = s on both sides (van de Hulst; Sekera).
RECIPROCAL = np.diag([1.0, 1.0, -1.0, 1.0])


def load(table: Array, um: float) -> tuple[Array, Array, Array, Array, Array]:
    """M/m00 in s and p of the surface, unpolarized BRDF, polar angles of both beams (deg), azimuth between (rad)."""
    s, m, wi, wo = in_surface_axes(table, um)
    azimuth = np.arctan2(np.cross(wi, wo)[:, 2], np.sum(wi[:, :2] * wo[:, :2], axis=1))
    return m, s[:, 5], np.rad2deg(np.arccos(wi[:, 2])), np.rad2deg(np.arccos(wo[:, 2])), azimuth


def partner(theta_i: Array, theta_r: Array, azimuth: Array, reverse: bool) -> tuple[Array, NDArray[np.int64]]:
    """Distance (about degrees) and row of the geometry nearest to the mirrored, or the reversed one."""

    def place(a: Array, b: Array, phi: Array) -> Array:
        radius = np.rad2deg(np.sin(np.deg2rad(np.minimum(a, b))))
        return np.stack([a, b, radius * np.cos(phi), radius * np.sin(phi)], axis=1)

    ends = (theta_r, theta_i) if reverse else (theta_i, theta_r)
    distance, row = cKDTree(place(theta_i, theta_r, azimuth)).query(place(*ends, -azimuth))
    return distance, row


def half_angle_deg(theta_i: Array, theta_r: Array, azimuth: Array) -> Array:
    """theta_d: half the angle between the directions to source and receiver."""
    a, b = np.deg2rad(theta_i), np.deg2rad(theta_r)
    cosine = np.cos(a) * np.cos(b) + np.sin(a) * np.sin(b) * np.cos(azimuth)
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1))) / 2


def noise_of_elements(m: Array, theta_i: Array, theta_r: Array, azimuth: Array) -> Array:
    """Standard deviation (geometries,) of an element of M/m00, from pairs that mirror symmetry makes equal.

    Root mean square over geometries of like theta_d (bins of 10 degrees), because noise grows where light is scarce.
    """
    distance, row = partner(theta_i, theta_r, azimuth, reverse=False)
    pair = (distance < 0.01) & (row != np.arange(len(m)))
    square = np.mean((m - MIRROR @ m[row] @ MIRROR).reshape(-1, 16)[:, 1:] ** 2, axis=1) / 2
    bins = np.minimum(half_angle_deg(theta_i, theta_r, azimuth) // 10, 6).astype(int)
    level = np.array([square[pair & (bins == k)].mean() for k in range(7)])
    return np.asarray(np.sqrt(level[bins]))


def triply_degenerate_with_noise(m: Array, sigma: Array, seed: int) -> Array:
    """The same matrices made triply degenerate, with noise in every element but m00."""
    xi0, m0 = xi0_and_dominant(m)
    noise = np.random.default_rng(seed).normal(size=m.shape) * sigma[:, None, None]
    noise[:, 0, 0] = 0
    return triply_degenerate.mueller_matrix(m0, xi0) + noise


def squared_deviation(xi: Array) -> Array:
    return np.sum(quantities.deviation_from_td(xi) ** 2, axis=-1)


def figure(table: Array, out: Path) -> None:
    drawn = Figure(figsize=(16, 7.6), layout="constrained")
    axes = drawn.subplots(2, 4)
    for column, um in enumerate(FOUND):
        m, _, ti, tr, phi = load(table, um)
        xi = coherency_eigenvalues(m)
        theta_d = half_angle_deg(ti, tr, phi)
        top, bottom = axes[0, column], axes[1, column]
        for k in range(4):
            top.plot(theta_d, xi[:, k], ".", ms=2, label=rf"$\xi_{k}$")
        top.axhline(0.25, color="0.5", lw=0.8)
        top.set(title=f"{1000 * um:.0f} nm", ylim=(0.1, 0.9), xlabel=r"$\theta_d$ / degrees")
        sigma = noise_of_elements(m, ti, tr, phi)
        fake = coherency_eigenvalues(triply_degenerate_with_noise(m, sigma, 0))
        for values, label in ((xi, "measured"), (fake, "triply degenerate + noise")):
            missed = 100 * quantities.td_missed(values)
            bottom.plot(theta_d, missed, ".", ms=2, label=label)
        bottom.set(ylim=(0, 8), xlabel=r"$\theta_d$ / degrees")
    axes[0, 0].set_ylabel("coherency eigenvalues")
    axes[1, 0].set_ylabel("light that the TD model misses / %")
    axes[0, 0].legend(markerscale=5)
    axes[1, 0].legend(markerscale=5)
    drawn.suptitle("Sintered PTFE (Germer 2017), 1824 geometries a wavelength")
    drawn.savefig(out, dpi=90)


@pytest.fixture(scope="module")
def table(public_files) -> np.ndarray:
    rows = np.genfromtxt(public_files("ptfe-mueller-brdf")["PTFE.data.csv"], delimiter=",", skip_header=1)
    assert rows.shape == (7296, 21)
    return rows


@pytest.mark.parametrize("um", FOUND)
def test_eigenvalues_over_all_geometries(table: np.ndarray, um: float) -> None:
    m, *_ = load(table, um)
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
    squared = ((4 * xi[:, 0] - 1) / 3) ** 2 + 4 / 3 * squared_deviation(xi)
    np.testing.assert_allclose(di**2, squared, atol=1e-14)
    # None of this depends on the axes of the file.
    raw = np.concatenate([np.ones((1824, 1)), table[table[:, 0] == um][:, 6:]], axis=1).reshape(-1, 4, 4)
    np.testing.assert_allclose(coherency_eigenvalues(raw), xi, atol=1e-12)


def test_the_picture_of_the_page(table: np.ndarray, tmp_path: Path) -> None:
    figure(table, tmp_path / "made.png")
    page = Path(__file__).parents[2] / "docs/images/ptfe_quantities.png"
    picture, shown = (cv2.imread(str(path)).astype(int) for path in (tmp_path / "made.png", page))
    # Fonts differ a little from one version of the drawing library to the next, curves do not.
    assert np.abs(picture - shown).mean() < 1


@pytest.mark.parametrize("um", FOUND)
def test_what_the_triply_degenerate_model_misses_beyond_noise(table: np.ndarray, um: float) -> None:
    m, _, *geometry = load(table, um)
    sigma = noise_of_elements(m, *geometry)
    fakes = [coherency_eigenvalues(triply_degenerate_with_noise(m, sigma, seed)) for seed in range(40)]
    measured = squared_deviation(coherency_eigenvalues(m)).mean()
    noise = np.mean([squared_deviation(xi).mean() for xi in fakes])
    true = np.sqrt((measured - noise) / 3)
    assert 0.0035 < true < 0.006  # about half a per cent of the light at all four wavelengths


@pytest.mark.parametrize("um", FOUND)
def test_reciprocity(table: np.ndarray, um: float) -> None:
    m, brdf, *geometry = load(table, um)
    distance, row = partner(*geometry, reverse=True)
    pair = (distance < 1.5) & (row != np.arange(len(m))) & (geometry[0] > 5) & (geometry[1] > 5)
    assert pair.sum() == 64
    assert np.std(np.log(brdf[pair] / brdf[row[pair]])) < 0.02
    back = np.swapaxes(m[row[pair]], 1, 2)

    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt(np.mean(difference.reshape(-1, 16)[:, 1:] ** 2)))

    reciprocal = rms(m[pair] - RECIPROCAL @ back @ RECIPROCAL)
    noise = np.sqrt(2 * np.mean(noise_of_elements(m, *geometry)[pair] ** 2))
    assert reciprocal < 1.1 * noise
    for signs in (np.eye(4), np.diag([1.0, 1.0, -1.0, -1.0]), np.diag([1.0, 1.0, 1.0, -1.0])):
        assert rms(m[pair] - signs @ back @ signs) > 1.25 * reciprocal
    assert rms(m[pair] - m[row[pair]]) > 1.25 * reciprocal
    # In the file's own axes of the reflected beam it does not hold.
    raw = np.concatenate([np.ones((1824, 1)), table[table[:, 0] == um][:, 6:]], axis=1).reshape(-1, 4, 4)
    unturned = raw[pair] - RECIPROCAL @ np.swapaxes(raw[row[pair]], 1, 2) @ RECIPROCAL
    assert rms(unturned) > 1.25 * reciprocal
