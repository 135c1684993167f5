"""Quantities of measured PTFE over all geometries: the tables of docs/studies/ptfe.md, and its figure.

Run: .venv/bin/python benchmarks/ptfe_quantities.py ../shared/data/ptfe-mueller-brdf/PTFE.data.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.arrays import Array
from processing.polarization import mueller, quantities, triply_degenerate
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant

WAVELENGTHS_UM = (0.351, 0.532, 0.633, 1.064)
MIRROR = np.diag([1.0, 1.0, -1.0, -1.0])
#: M of the reversed path is RECIPROCAL M^T RECIPROCAL, with x = s on both sides (van de Hulst; Sekera).
RECIPROCAL = np.diag([1.0, 1.0, -1.0, 1.0])
OTHER_HANDEDNESS = np.diag([1.0, 1.0, 1.0, -1.0])


def load(table: Array, um: float) -> tuple[Array, Array, Array, Array, Array]:
    """M/m00 in s and p of the surface, unpolarized BRDF, polar angles of both beams (deg), azimuth between (rad)."""
    s = table[table[:, 0] == um]
    m = np.concatenate([np.ones((len(s), 1)), s[:, 6:]], axis=1).reshape(-1, 4, 4)
    # The axes of the reflected beam are turned by its azimuth (docs/reflectance.md).
    m = mueller.rotation(-np.deg2rad(s[:, 4])) @ (OTHER_HANDEDNESS @ m @ OTHER_HANDEDNESS)
    wi, wo = (_direction(s[:, k], s[:, k + 1]) for k in (1, 3))
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


def _direction(theta_deg: Array, phi_deg: Array) -> Array:
    t, p = np.deg2rad(theta_deg), np.deg2rad(phi_deg)
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def tables(table: Array) -> None:
    print(
        "| um | noise of an element | xi0: 5 %, median, 95 % | DI: 5 %, median, 95 % | TD misses: median, 95 %, most |"
    )
    print("|---|---|---|---|---|")
    for um in WAVELENGTHS_UM:
        m, _, *geometry = load(table, um)
        xi = coherency_eigenvalues(m)
        missed, di = quantities.td_missed(xi), quantities.depolarization_index(m)
        sigma = noise_of_elements(m, *geometry)
        cells = [f"{um}", f"{np.sqrt(np.mean(sigma**2)):.4f}"]
        cells += [" ".join(f"{v:.3f}" for v in np.percentile(q, [5, 50, 95])) for q in (xi[:, 0], di)]
        cells += [" ".join(f"{v:.4f}" for v in (*np.percentile(missed, [50, 95]), missed.max()))]
        print("| " + " | ".join(cells) + " |")
    print("\n| um | TD misses, median | noise alone | noise taken off (rms) | beyond noise (2.4 % by chance) | rms "
          "|xi_k - mean| | unphysical |")  # fmt: skip
    print("|---|---|---|---|---|---|---|")
    for um in WAVELENGTHS_UM:
        m, _, *geometry = load(table, um)
        xi, sigma = coherency_eigenvalues(m), noise_of_elements(m, *geometry)
        fake = coherency_eigenvalues(np.concatenate([triply_degenerate_with_noise(m, sigma, s) for s in range(40)]))
        true = squared_deviation(xi).mean() - squared_deviation(fake).mean()
        over = np.mean(quantities.td_missed(xi) > quantities.td_missed(fake).reshape(40, -1).max(axis=0))
        cells = [
            f"{um}",
            f"{np.median(quantities.td_missed(xi)):.4f}",
            f"{np.median(quantities.td_missed(fake)):.4f}",
            f"{np.sqrt(max(true, 0) / 3):.4f}",
            f"{100 * over:.1f} %",
            f"{np.sqrt(squared_deviation(xi).mean() / 3):.4f}",
            f"{np.sum(xi[:, 3] < 0)}",
        ]
        print("| " + " | ".join(cells) + " |")
    print(
        "\n| um | reversed pairs | BRDF ratio, scatter | rms M - Q M'^T Q | without Q | not transposed | mirror pairs |"
    )
    print("|---|---|---|---|---|---|---|")
    for um in WAVELENGTHS_UM:
        m, brdf, *geometry = load(table, um)
        distance, row = partner(*geometry, reverse=True)
        pair = (distance < 1.5) & (row != np.arange(len(m))) & (geometry[0] > 5) & (geometry[1] > 5)
        a, b = m[pair], m[row[pair]]
        back = np.swapaxes(b, 1, 2)
        found = [a - RECIPROCAL @ back @ RECIPROCAL, a - back, a - b]
        ratio = brdf[pair] / brdf[row[pair]]
        rms = [f"{np.sqrt(np.mean(f.reshape(-1, 16)[:, 1:] ** 2)):.4f}" for f in found]
        mirror = np.sqrt(2 * np.mean(noise_of_elements(m, *geometry)[pair] ** 2))
        print(f"| {um} | {pair.sum() // 2} | {np.std(np.log(ratio)):.4f} | {' | '.join(rms)} | {mirror:.4f} |")
    print("\n| um | theta_d: " + " | ".join(f"{a}-{a + 15}" for a in range(0, 75, 15)) + " |")
    for um in WAVELENGTHS_UM:
        m, _, ti, tr, phi = load(table, um)
        theta_d = half_angle_deg(ti, tr, phi)
        xi = coherency_eigenvalues(m)
        missed = quantities.td_missed(xi)
        cells = []
        for a in range(0, 75, 15):
            inside = (theta_d >= a) & (theta_d < a + 15)
            cells.append(f"{np.median(xi[inside, 0]):.3f}, {np.median(missed[inside]):.4f}")
        print(f"| {um} | " + " | ".join(cells) + " |")


def figure(table: Array, out: Path) -> None:
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(16, 7.6), layout="constrained")
    axes = drawn.subplots(2, 4)
    for column, um in enumerate(WAVELENGTHS_UM):
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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--figure", type=Path, default=Path(__file__).parents[1] / "docs/images/ptfe_quantities.png")
    options = parser.parse_args()
    rows = np.genfromtxt(options.csv, delimiter=",", skip_header=1)
    tables(rows)
    figure(rows, options.figure)
