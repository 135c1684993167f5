"""Figures of products: Mueller images as 4 x 4 panels, Stokes images, single maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.reports.colours import SIGNED, upper_end
from processing.reports.figure_style import (
    CYCLIC,
    WORST_ORIENTATION_DEG,
    clipped,
    entitle,
    grid_figure,
    map_figure,
    percentile,
    thin,
)
from processing.reports.quantities_figures import quantities_figure
from processing.storage.products.product import Product, is_lit
from processing.whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A standard error of xi0 above this is no knowledge of it: valid values lie between 0.25 and 1.
UNKNOWN_XI0 = 0.1


def draw_product(path: Path, figure: Path) -> None:
    """Draw a product into a PNG, SVG or PDF file, by its kind.

    Raises ProcessError: there is no figure for that kind, or the file's ending is unknown.
    """
    with Product(path) as product:
        drawn = product_figure(product)
    try:
        with whole_file(figure) as new:
            drawn.savefig(new, dpi=150)
    except (ValueError, OSError) as error:
        raise ProcessError(f"figure {figure} cannot be written: {error}") from error


def product_figure(product: Product) -> Figure:
    """Matplotlib figure of a product; raises ProcessError for a kind without one."""
    if product.kind in ("mueller", "quantities") and (light := _stokes_of(product)) is not None:
        return _polarimeter_figure(product, *light)
    if product.kind in ("mueller", "extrapolated"):
        elements = thin(product.get("mueller"))
        lit = is_lit(elements[0, 0], thin(product.get("mueller_errors")[0, 0]))
        title = _title(product) if product.kind == "mueller" else f"extrapolated: {_title(product)}"
        return mueller_figure(elements, lit, title, product.simulated)
    if product.kind == "stokes":
        names = ("s0", "dolp", "dolp_errors", "aolp_deg", "aolp_deg_errors")
        maps = {name: thin(product.get(name)) for name in names}
        dark = ~is_lit(maps["s0"], thin(product.get("s0_errors")))
        for name in names[1:]:
            maps[name][dark] = np.nan
        return stokes_figure(maps, _title(product), product.simulated)
    if product.kind == "xi0":
        xi0, errors, valid = (thin(product.get(name)) for name in ("xi0", "xi0_errors", "valid"))
        shown = np.where(valid > 0, xi0, np.nan)
        limited = np.where(errors <= UNKNOWN_XI0, errors, np.nan)
        panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
            (
                f"$\\xi_0$ (grey: not valid, {100 * np.mean(valid == 0):.0f} % of the image)",
                shown,
                {"cmap": "viridis", "vmin": 0.25, "vmax": max(upper_end(shown), 0.26)},
            ),
            (
                f"standard error of $\\xi_0$ (grey: > {UNKNOWN_XI0:g})",
                limited,
                {"cmap": "magma", "vmin": 0, "vmax": max(percentile(errors[valid > 0], 95), 1e-6)},
            ),
        ]
        return map_figure(panels, _title(product), product.simulated)
    if product.kind == "quantities":
        return quantities_figure(product, _title(product))
    if product.kind == "camera":
        return photon_transfer_figure(product)
    raise ProcessError(f"{product.path}: there is no figure of the {product.kind} kind.")


def mueller_figure(elements: NDArray[Any], lit: NDArray[np.bool_], title: str, simulated: bool) -> Figure:
    """4 x 4 panels of M / m00 (4, 4, rows, columns), one diverging scale symmetric about zero, one colour bar.

    Pixels that are not `lit` (rows, columns) have no M / m00 to show and stay grey. The scale is the largest
    magnitude apart from m00 (99.5 % of the pixels), at most 1; the m00 panel shows m00 over its own 99.5 % so that
    the object can be recognised, and is drawn in grey.
    """
    from matplotlib.figure import Figure

    m00 = elements[0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        normalized = np.where(lit, elements / m00, np.nan)
    ratios = normalized.reshape(16, *m00.shape)[1:]
    limit = float(np.clip(percentile(np.abs(ratios), 99.5), 1e-6, 1.0))
    figure = Figure(figsize=(9.5, 8.6 * max(0.45, m00.shape[0] / max(m00.shape[1], 1)) + 0.8), layout="constrained")
    panels = figure.subplots(4, 4)
    shown: Any = None
    for i in range(4):
        for j in range(4):
            panel = panels[i, j]
            panel.xaxis.set_visible(False)
            panel.yaxis.set_visible(False)
            panel.set_facecolor("0.85")
            panel.set_title(f"$m_{{{i}{j}}}$", fontsize=9, pad=2)
            if i == j == 0:
                panel.imshow(m00, cmap="gray", vmin=0, vmax=max(percentile(m00, 99.5), 1e-30))
                continue
            if not np.isfinite(elements[i, j]).any():
                panel.text(0.5, 0.5, "not\ndetermined", ha="center", va="center", fontsize=8, transform=panel.transAxes)
                continue
            shown = panel.imshow(normalized[i, j], cmap=SIGNED, vmin=-limit, vmax=limit, interpolation="nearest")
    label = "$m_{ij}/m_{00}$, instrument frames (first panel: $m_{00}$; plain grey: too dark)"
    figure.colorbar(shown, ax=panels, shrink=0.8, label=label, extend=clipped(ratios, -limit, limit))
    entitle(figure, title, simulated)
    return figure


def stokes_figure(maps: dict[str, NDArray[Any]], title: str, simulated: bool) -> Figure:
    """S0 (grey), degree of linear polarization with its standard error, and its angle on a cyclic colour map."""
    angle = np.where(maps["aolp_deg_errors"] <= WORST_ORIENTATION_DEG, maps["aolp_deg"], np.nan)
    panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        ("$S_0$ / counts", maps["s0"], {"cmap": "gray", "vmin": 0}),
        (
            "degree of linear polarization",
            maps["dolp"],
            {"cmap": "viridis", "vmin": 0, "vmax": upper_end(maps["dolp"])},
        ),
        ("its standard error", maps["dolp_errors"], {"cmap": "magma", "vmin": 0}),
        ("angle of linear polarization, PSA frame / degrees", angle, CYCLIC),
    ]
    return grid_figure(panels, title, simulated)


def photon_transfer_figure(product: Product) -> Figure:
    """Variance against signal with the fitted line, and the residual."""
    from matplotlib.figure import Figure

    signal, variance, stderr = product.array("photon_transfer")
    fitted = product.facts["slope"] * signal + product.facts["floor"]
    figure = Figure(figsize=(7, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    upper.errorbar(signal, variance, stderr, fmt=".", label="pairs of repeated frames")
    gain, read = product.facts["gain_e_per_count"], product.facts["read_noise_e"]
    upper.plot(signal, fitted, label=f"{gain:.4g} e/count, {read:.3g} e read noise")
    upper.set_ylabel("variance / counts$^2$")
    upper.legend()
    lower.errorbar(signal, (variance - fitted) / fitted * 100, stderr / fitted * 100, fmt=".")
    lower.axhline(0, color="black", linewidth=0.8)
    lower.set_ylabel("residual / %")
    lower.set_xlabel("signal above black / counts")
    entitle(figure, f"photon transfer: {product.header.title}", product.simulated)
    return figure


def _title(product: Product) -> str:
    header = product.header
    wavelength = f"{header.wavelength_nm:g} nm"
    return header.title if wavelength in header.title else f"{header.title}, {wavelength}"


def _stokes_of(product: Product) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Stokes vector and standard errors (4, rows, columns) of a product that determines no more than these.

    Of the light that is sent back, or of unpolarized light: the first column of M. None where M has other elements.
    """
    if "stokes" in product.names:
        return thin(product.get("stokes")), thin(product.get("stokes_errors"))
    if product.kind != "mueller":
        return None
    elements = thin(product.get("mueller"))
    if np.isfinite(elements[:, 1:]).any() or not np.isfinite(elements[1:, 0]).any():
        return None
    return elements[:, 0], thin(product.get("mueller_errors")[:, 0])


def _polarimeter_figure(product: Product, stokes: NDArray[Any], errors: NDArray[Any]) -> Figure:
    """S0, S1..S3 over S0, the degrees, angle and ellipticity that they determine, and the Poincare sphere.

    Dark pixels stay grey. A product of `process quantities` has its own maps, without the noise in magnitudes.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        lit = is_lit(stokes[0], errors[0])
        s1, s2, s3 = np.where(lit, stokes[1:] / stokes[0], np.nan)
        linear = np.hypot(s1, s2)
        noise = np.hypot(s1 * errors[2], s2 * errors[1]) / (2 * linear**2 * stokes[0])
        degree = np.sqrt(s1**2 + s2**2 + s3**2)
        maps = {
            "dop": degree,
            "dolp": linear,
            "docp": s3,
            "aolp_deg": np.rad2deg(np.arctan2(s2, s1)) / 2 % 180,
            "ellipticity_deg": np.rad2deg(np.arctan2(s3, linear)) / 2,
        }
    maps |= {name: np.where(lit, thin(product.get(name)), np.nan) for name in maps if name in product.names}
    for name, error in (("aolp_deg", noise), ("ellipticity_deg", errors[1:].max(axis=0) / (2 * degree * stokes[0]))):
        maps[name] = np.where(np.rad2deg(error) > WORST_ORIENTATION_DEG, np.nan, maps[name])
    panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        ("$S_0$ / counts", stokes[0], {"cmap": "gray", "vmin": 0})
    ]
    for label, shown in (("$S_1 / S_0$", s1), ("$S_2 / S_0$", s2), ("$S_3 / S_0$", s3)):
        limit = max(percentile(np.abs(shown), 99.5), 1e-6) if np.isfinite(shown).any() else 1.0
        panels.append((label, shown, {"cmap": SIGNED, "vmin": -limit, "vmax": limit}))
    for label, name in (("degree of polarization", "dop"), ("degree of linear polarization", "dolp")):
        panels.append((label, maps[name], {"cmap": "viridis", "vmin": 0, "vmax": upper_end(maps[name])}))
    circular = np.abs(maps["docp"])
    panels += [
        ("degree of circular polarization", circular, {"cmap": "viridis", "vmin": 0, "vmax": upper_end(circular)}),
        ("angle of linear polarization, PSA frame / degrees", maps["aolp_deg"], CYCLIC),
        ("ellipticity angle / degrees", maps["ellipticity_deg"], {"cmap": SIGNED, "vmin": -45, "vmax": 45}),
    ]
    # Where S3 is not determined, nothing follows from it.
    shown_panels = [panel for panel in panels if np.isfinite(panel[1]).any()]
    sphere = np.stack([s1, s2, np.nan_to_num(s3) if np.isnan(s3).all() else s3]).reshape(3, -1)
    return grid_figure(shown_panels, _title(product), product.simulated, sphere=sphere)
