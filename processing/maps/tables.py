"""Fill tables over scattering geometry from products: Mueller matrices, or xi0."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.geometry.frames import GeometryImage
from processing.geometry.viewing import ViewingGeometry
from processing.reduction.mueller import Progress
from processing.reduction.systematic import INPUTS
from processing.reflectance.pbsdf import MUELLER, to_renderer_frames
from processing.reflectance.shared_noise import shared_variance
from processing.reflectance.table_axes import Layout
from processing.reflectance.tables import ScatteringTable
from processing.storage.products.images import neighbour_correlation as noise_between
from processing.storage.products.images import require_all_elements
from processing.storage.products.product import Product


def xi0_samples(
    table: ScatteringTable,
    image: GeometryImage,
    xi0: NDArray[np.floating],
    stderr: NDArray[np.floating],
    correlation: NDArray[np.float64],
) -> NDArray[np.float64]:
    """xi0 and its variance (2, N) on the pixels of an object, covariances within each bin of the table included.

    Parameters
    ----------
    xi0, stderr : (N,); a standard error of NaN does not count.
    correlation : of the noise of two pixels by their distance, see `shared_variance`.
    """
    bins = np.full(image.mask.shape, -1, np.int32)
    bins[image.mask] = table.axes.bins(image.points.angles)
    sigma = np.full(image.mask.shape, np.nan)
    sigma[image.mask] = stderr
    return np.stack([xi0, shared_variance(bins, sigma, correlation)[image.mask]]).astype(float)


def _xi0_values(table: ScatteringTable, image: GeometryImage, product: Product) -> NDArray[np.float64]:
    """Values (quantities, N) of a table from a whole xi0 product; NaN where that is not valid."""
    valid = product.get("valid")[image.mask] > 0
    xi0, error = (product.get(name)[image.mask] for name in ("xi0", "xi0_errors"))
    values = xi0_samples(table, image, xi0, np.where(valid, error, np.nan), noise_between(product))
    if len(table.quantities) > len(values):
        if table.quantities[2:] != _directions(product):
            raise ProcessError(
                f"{product.path} was reduced with an instrument of other uncertain values than those in the table. "
                "Reduce all captures with one file: process reduce --instrument FILE"
            )
        values = np.concatenate([values, product.get("xi0_directions")[:, image.mask]])
    values[:, ~valid] = np.nan
    return values


def _directions(product: Product) -> tuple[str, ...]:
    """Quantities of a table: what one standard uncertainty of each uncertain input of the instrument does to xi0."""
    if product.kind != "xi0" or INPUTS not in product.facts:
        return ()
    labels = str(product.facts[INPUTS]).replace(", ", "+").split("; ")
    return tuple(f"xi0_direction_{k}_{label}" for k, label in enumerate(labels))


def tabulate(
    sources: Sequence[Path],
    geometry_file: Path,
    layout: Layout,
    table: ScatteringTable | None = None,
    progress: Progress | None = None,
) -> ScatteringTable:
    """Add the images of products to a table; a new one is made if none is given.

    Mueller matrices are turned into the renderer's axes pixel by pixel, so that pixels of one bin are alike.
    xi0 products add their valid pixels, with the variance of each and its covariances with the other pixels of the bin,
    so that tables can be compared with their noise. Those of Mueller images are not averaged over neighbours. The
    mean of each direction of the instrument's uncertainty is in the table: the root of their sum of squares is the
    systematic uncertainty of a bin's mean xi0.

    Raises
    ------
    ProcessError : products of another kind or wavelength, without an arm angle, or simulated and measured mixed.
    """
    view = ViewingGeometry.load(geometry_file)
    for done, source in enumerate(sources, 1):
        with Product(source) as product:
            product.require("mueller", "xi0")
            if product.kind == "mueller":
                require_all_elements(product)
            header, simulated, kind = product.header, product.simulated, product.kind
            if header.omega_deg is None:
                raise ProcessError(f"{source}: the capture does not say its arm angle; it belongs to no bin.")
            if table is None:
                of_xi0 = ("xi0", "xi0_variance", *_directions(product))
                names, frames = (MUELLER, "renderer") if kind == "mueller" else (of_xi0, "")
                table = ScatteringTable(names, header.wavelength_nm, layout, simulated, frames)
            if abs(table.wavelength_nm - header.wavelength_nm) > 0.5:
                raise ProcessError(
                    f"{source} is at {header.wavelength_nm:g} nm, the table at {table.wavelength_nm:g} nm; "
                    "make one table for each wavelength."
                )
            # Neighbours share noise across the borders of blocks.
            blocks = product.row_blocks() if kind == "mueller" else [slice(0, product.shape[0])]
            for rows in blocks:
                image = view.at(header.omega_deg, *product.shape, block=rows)
                if not image.mask.any():
                    continue
                if kind == "mueller":
                    m = np.moveaxis(product.get("mueller", rows), (0, 1), (-2, -1))[image.mask]
                    values = to_renderer_frames(m, image.points).reshape(-1, 16).T
                else:
                    values = _xi0_values(table, image, product)
                table.add(image.points.angles, values, simulated)
        if progress:
            progress(done, len(sources))
    if table is None:
        raise ProcessError("no product was given; there is nothing to tabulate.")
    return table
