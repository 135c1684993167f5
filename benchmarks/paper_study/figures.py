"""The figures of the paper, from the study's products, in the paper's order."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from paper_study.acquire import SHOWN_DEG
from paper_study.process import BODY, SPHERE, TABLE_I, BodyProducts, SphereStudy

from processing.campaign.run import PAPER
from processing.geometry.viewing import ViewingGeometry
from processing.polarization.cloude import xi0_and_dominant
from processing.polarization.image_difference import linear_diattenuation, magnitude, orientation_difference
from processing.polarization.quantities import PAPER_PAIRS
from processing.reflectance import fresnel
from processing.reflectance.base import load_reflectance, normalized_mueller
from processing.reflectance.polarized_diffuse import diffuse_jones
from processing.reflectance.tables import ScatteringTable
from processing.reports.figure_style import CYCLIC, entitle, grid_figure, percentile
from processing.reports.reflectance_figures import STYLES, tables_figure
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product, is_lit

Panels = list[tuple[str, NDArray[Any], dict[str, Any]]]
FRAMES = "Instrument frames; rows and columns of tiles are those of the matrix."
#: Where an orientation is drawn in grey: |D| below this has none.
NO_ORIENTATION = 0.01


class Shown(NamedTuple):
    """A figure and its caption."""

    figure: Figure
    caption: str


class Dominant(NamedTuple):
    """Dominant process of an image, measured and modelled, (rows, columns, 4, 4), and where the object is."""

    measured: NDArray[np.floating]
    modelled: NDArray[np.floating]
    mask: NDArray[np.bool_]


def scattering_angles(pixels: int) -> Shown:
    """theta_h, theta_d and phi_d of sphere and body."""
    panels: Panels = []
    for name, file in (("sphere", SPHERE), ("body", BODY)):
        view = ViewingGeometry.load(file).at(SHOWN_DEG, pixels, pixels)
        for label, angle, keywords in zip(
            (r"$\theta_h$", r"$\theta_d$", r"$\phi_d$"),
            view.points.angles,
            ({"vmin": 0, "vmax": 90}, {"vmin": 0, "vmax": 45}, {"cmap": "twilight", "vmin": -180, "vmax": 180}),
            strict=True,
        ):
            panels.append((f"{name}, {label} / degrees", view.fill(np.rad2deg(angle)), keywords))
    return Shown(_grid(panels, 3), f"Rusinkiewicz angles at Omega {SHOWN_DEG:g} degrees (paper, Fig. 4).")


def model_terms(nm: float, pixels: int) -> Shown:
    """Mueller images of the two terms of the model over the sphere."""
    view = ViewingGeometry.load(SPHERE).at(SHOWN_DEG, pixels, pixels)
    constants = load_reflectance(TABLE_I).constants[nm]
    terms = {
        "first surface": fresnel.jones(view.points, complex(constants.n, constants.k)),
        "polarized diffuse": diffuse_jones(view.points),
    }
    matrices = {f"{name}, {nm:g} nm": view.fill(normalized_mueller(jones)) for name, jones in terms.items()}
    return Shown(_tiled(matrices), f"Mueller images of the model's two terms, {nm:g} nm (paper, Fig. 5). {FRAMES}")


def dominant(product: Path, geometry: Path, material: Path) -> Dominant:
    """Measured and modelled dominant process of a Mueller product at its geometry."""
    image = MuellerImage.load(product)
    header = image.header
    view = ViewingGeometry.load(geometry).at(float(header.omega_deg or 0), *image.mask.shape)
    model = load_reflectance(material).mueller_jones(view.points, header.wavelength_nm)
    lit = is_lit(image.values[0, 0], image.errors[0, 0])
    measured = np.where(lit[..., None, None], xi0_and_dominant(image.matrices.astype(float))[1], np.nan)
    measured[~view.mask] = np.nan
    return Dominant(measured, view.fill(np.asarray(model, dtype=float)), view.mask)


def dominant_images(name: str, images: Mapping[float, Dominant]) -> Shown:
    """Mueller images of the measured and the modelled dominant process."""
    matrices = {
        f"{part}, {nm:g} nm": getattr(image, part) for nm, image in images.items() for part in ("measured", "modelled")
    }
    return Shown(_tiled(matrices), f"Dominant process of the {name}, its m00 = 1 (paper, Fig. 6). {FRAMES}")


def orientation(images: Mapping[float, Dominant]) -> Shown:
    """psi measured, modelled, and how far they are apart."""
    panels: Panels = []
    for nm, image in images.items():
        for part in ("measured", "modelled"):
            panels.append((rf"$\psi$ {part}, {nm:g} nm / degrees", _psi(getattr(image, part)), CYCLIC))
        a, b = (linear_diattenuation(m) for m in (image.modelled, image.measured))
        delta = np.abs(np.rad2deg(orientation_difference(a, b)))
        panels.append((rf"deviation, {nm:g} nm / degrees", delta, {"cmap": "magma", "vmin": 0, "vmax": 45}))
    caption = "Orientation psi of the diattenuation of the dominant process (paper, Fig. 7), with its noise."
    return Shown(_grid(panels, 3), caption)


def diattenuation(images: Mapping[float, Dominant]) -> Shown:
    """|D| measured, modelled and the difference."""
    panels: Panels = []
    for nm, image in images.items():
        for part in ("measured", "modelled"):
            d = magnitude(linear_diattenuation(getattr(image, part)))
            panels.append((f"$|D|$ {part}, {nm:g} nm", d, {"vmin": 0, "vmax": 1}))
        a, b = (magnitude(linear_diattenuation(m)) for m in (image.modelled, image.measured))
        panels.append((f"modelled - measured, {nm:g} nm", a - b, {"cmap": "RdBu_r", "vmin": -0.3, "vmax": 0.3}))
    caption = (
        "Magnitude of the diattenuation of the dominant process (paper, Fig. 8). At 662 nm there are two neutral "
        "points, one on either side of the specular point."
    )
    return Shown(_grid(panels, 3), caption)


def deviations(study: SphereStudy) -> Shown:
    """RMSD of psi, |D| and xi0 against Omega, with the paper's averages and what noise and registration make."""
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    panels = figure.subplots(1, 3)
    for panel, (name, label) in zip(panels, QUANTITIES.items(), strict=True):
        for nm in sorted({row.wavelength_nm for row in study.as_told.rows}):
            colour, marker = STYLES.get(round(nm), ("tab:green", "o"))
            rows = [row for row in study.as_told.rows if row.wavelength_nm == nm]
            omega = [row.omega_deg for row in rows]
            noise = NOISE[name]
            panel.plot(omega, [getattr(row, name) for row in rows], color=colour, marker=marker, label=f"{nm:g} nm")
            panel.plot(omega, [getattr(row, noise) for row in rows], color=colour, linestyle=":")
            panel.axhline(getattr(PAPER[round(nm)], name), color=colour, linestyle="--", linewidth=0.8)
        panel.plot([], [], color="0.3", linestyle=":", label="noise alone")
        panel.plot([], [], color="0.3", linestyle="--", linewidth=0.8, label="paper, average")
        panel.set_xlabel(r"$\Omega$ / degrees")
        panel.set_ylabel(f"RMSD of {label}")
        panel.set_ylim(bottom=0)
        panel.legend(fontsize=8)
    entitle(figure, "model against measurement", True)
    return Shown(figure, "RMSD over the sphere against the angle of the arm (paper, Figs. 9 and 11).")


def lookup_tables(study: SphereStudy, nm: float, pixels: int) -> Shown:
    """xi0 of both instruments' tables on a virtual sphere, and the difference."""
    tables = [ScatteringTable.load(study.as_told.tables[kind, nm]) for kind in ("mueller", "stokes")]
    view = study.as_told.views["stokes"]
    figure = tables_figure(tables[0], tables[1], view, SHOWN_DEG, shape=(pixels, pixels))
    caption = f"xi0 through tables of one-degree bins, {nm:g} nm: Mueller, Stokes, difference (paper, Fig. 10)."
    return Shown(figure, caption)


def eigenvalues(body: Mapping[float, BodyProducts]) -> Shown:
    """Small eigenvalues minus their mean, of the body."""
    panels: Panels = []
    for nm, products in body.items():
        with Product(products.quantities) as product:
            deviation = np.where(product.get("lit") > 0, product.get("eigenvalue_deviation"), np.nan)
        limit = 0.09 if nm < 500 else 0.03
        for k, image in enumerate(deviation, 1):
            keywords = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
            panels.append((rf"$\xi_{k} - \bar\xi$, {nm:g} nm", image, keywords))
    caption = (
        "Small eigenvalues of the body minus their mean (paper, Fig. 2), on scales of the paper's largest, 9 and 3 %. "
        "Noise is in these maps: it pushes equal eigenvalues apart."
    )
    return Shown(_grid(panels, 3), caption)


def polarizer_pairs(body: Mapping[float, BodyProducts]) -> Shown:
    """The body between polarizers: measured on the left, extrapolated from the Stokes image on the right."""
    panels: Panels = []
    for nm, products in body.items():
        with Product(products.quantities) as measured, Product(products.extrapolated_quantities) as extrapolated:
            lit = (measured.get("lit") > 0) & np.isfinite(extrapolated.get("crossed_linear"))
            for name in PAPER_PAIRS:
                pair = [np.where(lit, product.get(name), np.nan) for product in (measured, extrapolated)]
                values = np.concatenate([image[lit] for image in pair])
                low, high = (float(np.percentile(values, p)) for p in (1, 99)) if values.size else (0.0, 1.0)
                label = f"{name.replace('_', ' ')}, {nm:g} nm: correlation {_correlation(*pair):.2f}"
                cut = _object_only(pair)
                tile = np.concatenate([pair[0][cut], _gap(pair[0][cut], axis=1), pair[1][cut]], axis=1)
                panels.append((label, tile, {"cmap": "gray", "vmin": low, "vmax": high}))
    caption = (
        "The body between two polarizers, light over m00 (paper, Fig. 12): on the left measured by the Mueller "
        "polarimeter, on the right extrapolated from one linear Stokes image. Each pair has one scale."
    )
    return Shown(grid_figure(panels, "", True, 3), caption)


def fault_images(before: Dominant, after: Dominant, nm: float) -> Shown:
    """Deviation of psi before and after the correction."""
    panels: Panels = []
    for name, image in (("before", before), ("after", after)):
        a, b = (linear_diattenuation(m) for m in (image.modelled, image.measured))
        psi = np.rad2deg(orientation_difference(b, a))
        panels.append((rf"$\psi$ measured - model, {name} / degrees", psi, {"cmap": "RdBu_r", "vmin": -10, "vmax": 10}))
    return Shown(_grid(panels, 2), f"Deviation of psi with the undeclared fault, and after `diagnose`, {nm:g} nm.")


QUANTITIES = {"psi_deg": r"$\psi$ / degrees", "magnitude_percent": "$|D|$ / %", "xi0_percent": r"$\xi_0$ / %"}
NOISE = {
    "psi_deg": "psi_noise_deg",
    "magnitude_percent": "magnitude_noise_percent",
    "xi0_percent": "xi0_noise_percent",
}


def _grid(panels: Sequence[tuple[str, NDArray[Any], dict[str, Any]]], columns: int) -> Figure:
    cut = _object_only([values for _, values, _ in panels])
    return grid_figure([(label, values[cut], keywords) for label, values, keywords in panels], "", True, columns)


def _object_only(images: Sequence[NDArray[Any]]) -> tuple[slice, slice]:
    """The part of the frame that any of the images has something in."""
    valid = np.any([np.isfinite(image) for image in images], axis=0)
    rows, columns = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return slice(None), slice(None)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _tiled(matrices: Mapping[str, NDArray[np.floating]]) -> Figure:
    """Mueller images (rows, columns, 4, 4) as panels of 4 x 4 tiles on one scale."""
    panels: Panels = []
    for label, m in matrices.items():
        cut = m[_object_only([m[..., 0, 0]])]
        gap = _gap(cut[..., 0, 0], axis=1)
        lines = []
        for i in range(4):
            tiles = [part for j in range(4) for part in (cut[..., i, j], gap)][:-1]
            lines += [np.concatenate(tiles, axis=1)]
            lines += [_gap(lines[0], axis=0)]
        panels.append((label, np.concatenate(lines[:-1], axis=0), {"cmap": "RdBu_r", "vmin": -1, "vmax": 1}))
    return grid_figure(panels, "", True, 2)


def _gap(image: NDArray[np.floating], axis: int) -> NDArray[np.floating]:
    width = max(2, max(image.shape) // 30)
    return np.full((width, image.shape[1]) if axis == 0 else (image.shape[0], width), np.nan)


def _psi(m: NDArray[np.floating]) -> NDArray[np.floating]:
    d = linear_diattenuation(m)
    psi = np.mod(np.rad2deg(0.5 * np.arctan2(d[..., 1], d[..., 0])), 180)
    return np.where(magnitude(d) > NO_ORIENTATION, psi, np.nan)


def _correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    valid = np.isfinite(a) & np.isfinite(b)
    # A few pixels at the outline are far off and would decide alone.
    keep = valid & (a < percentile(a, 99.5)) & (b < percentile(b, 99.5))
    return float(np.corrcoef(a[keep], b[keep])[0, 1]) if keep.sum() > 2 else float("nan")
