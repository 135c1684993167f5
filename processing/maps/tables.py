"""Fill tables over scattering geometry from products: Mueller matrices, or xi0."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.doors import require_distinct
from processing.errors import ProcessError
from processing.geometry.frames import GeometryImage
from processing.geometry.viewing import ViewingGeometry
from processing.reduction.mueller import Progress
from processing.reflectance.pbsdf import MUELLER, to_renderer_frames
from processing.reflectance.shared_noise import shared_variance
from processing.reflectance.table_axes import Layout
from processing.reflectance.tables import ScatteringTable
from processing.storage.images import neighbour_correlation as noise_between
from processing.storage.images import require_all_elements
from processing.storage.product import Product


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
    so that tables can be compared with their noise. Those of Mueller images are not averaged over neighbours.

    Raises
    ------
    ProcessError : products of another kind or wavelength, without an arm angle, or simulated and measured mixed.
    """
    require_distinct(sources)
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
                names, frames = (MUELLER, "renderer") if kind == "mueller" else (("xi0", "xi0_variance"), "")
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
                    valid = product.get("valid", rows)[image.mask] > 0
                    xi0, error = (product.get(name, rows)[image.mask] for name in ("xi0", "xi0_errors"))
                    values = xi0_samples(table, image, xi0, np.where(valid, error, np.nan), noise_between(product))
                    values[:, ~valid] = np.nan
                table.add(image.points.angles, values, simulated)
        if progress:
            progress(done, len(sources))
    if table is None:
        raise ProcessError("no product was given; there is nothing to tabulate.")
    return table
