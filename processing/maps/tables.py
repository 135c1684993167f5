"""Fill tables over scattering geometry from products: Mueller matrices, or xi0."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.errors import ProcessError
from processing.geometry.frames import GeometryImage, frame_turns
from processing.geometry.viewing import ViewingGeometry
from processing.maps.white_reference import SCALE, WhiteReference
from processing.reduction.mueller import Progress
from processing.reduction.systematic import INPUTS, Systematic
from processing.reflectance.pbsdf import MUELLER
from processing.reflectance.shared_noise import shared_variance
from processing.reflectance.table_axes import Layout
from processing.reflectance.tables import BinGroups, ScatteringTable
from processing.storage.products.images import MuellerImage, require_all_elements
from processing.storage.products.images import neighbour_correlation as noise_between
from processing.storage.products.product import Product

#: Elements of a Mueller matrix that turning both axes mixes.
_MIXED = ((0,), (3,), (12,), (15,), (1, 2), (4, 8), (7, 11), (13, 14), (5, 6, 9, 10))


def xi0_samples(
    table: ScatteringTable,
    image: GeometryImage,
    xi0: NDArray[np.floating],
    stderr: NDArray[np.floating],
    *,
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
    """Values (planes, N) of a table from a whole xi0 product; NaN where that is not valid."""
    valid = product.get("valid")[image.mask] > 0
    xi0, error = (product.get(name)[image.mask] for name in ("xi0", "xi0_errors"))
    values = xi0_samples(table, image, xi0, np.where(valid, error, np.nan), correlation=noise_between(product))
    if table.inputs:
        values = np.concatenate([values, product.get("xi0_directions")[:, image.mask]])
    values[:, ~valid] = np.nan
    return values


def _add_mueller(
    table: ScatteringTable, image: GeometryImage, product: Product, *, rows: slice, white: WhiteReference | None
) -> None:
    """Add some rows of a Mueller product to a table, turned into the renderer's axes.

    Uncertainties are those of the mean pixel of each bin: it moves and is turned like the others of its bin.
    """
    block = MuellerImage.of(product, rows).at(np.flatnonzero(image.mask))
    left, right = (np.ascontiguousarray(np.moveaxis(m, 0, -1)) for m in frame_turns(image.points, image.points.half))
    factor = np.ones(left.shape[-1]) if white is None else white.factor(product, image)
    values = factor * _turn(block.values.reshape(16, -1), _shares(left, right))
    if table.has_noise:
        values[:, ~np.isfinite(block.errors.reshape(16, -1).sum(axis=0))] = np.nan

    def uncertainty(groups: BinGroups) -> Iterator[Array]:
        pixels, turns = block.averaged(groups.mean), _shares(groups.mean(left), groups.mean(right))
        scale = groups.mean(factor)
        if table.has_noise:
            yield np.square(scale) * _turn_variance(pixels, turns)
        if table.inputs and (systematic := Systematic.of_product(product)) is not None:
            for moved in systematic.moves(pixels.values.reshape(16, -1), is_held=False):
                yield scale * _turn(moved, turns)
        if white is not None:
            yield white.u * groups.mean(values)

    table.add(image.points.angles, values, product.simulated, uncertainty)


def _shares(left: Array, right: Array) -> dict[tuple[int, int], Array]:
    """Share (N,) of each element (second) in each turned element (first), for turning matrices (4, 4, N)."""
    return {(k, i): left[k // 4, i // 4] * right[i % 4, k % 4] for g in _MIXED for k in g for i in g}


def _turn(values: NDArray[np.floating], share: Mapping[tuple[int, int], Array]) -> Array:
    """Elements (16, N) in turned axes."""
    elements = np.zeros(values.shape)
    for (k, i), part in share.items():
        elements[k] += part * values[i]
    return elements


def _turn_variance(image: MuellerImage, share: Mapping[tuple[int, int], Array]) -> Array:
    """Variance (16, N) of the elements in turned axes."""
    pairs = [pair for group in _MIXED for pair in combinations_with_replacement(group, 2)]
    variance = np.zeros((16, image.mask.size))
    for (i, j), between in zip(pairs, image.covariances_between(pairs), strict=True):
        for k in next(group for group in _MIXED if i in group):
            variance[k] += (1 + (i != j)) * share[k, i] * share[k, j] * between
    return variance


def _table_for(product: Product, layout: Layout, white: WhiteReference | None) -> ScatteringTable:
    """An empty table for the samples of a product."""
    product.require("mueller", "xi0")
    names: tuple[str, ...] = ("xi0",)
    frames, has_noise = "", True
    if product.kind == "mueller":
        require_all_elements(product)
        names, frames, has_noise = MUELLER, "renderer", bool(np.isfinite(product.get("mueller_errors")).any())
    if product.header.omega_deg is None:
        raise ProcessError(f"{product.path}: the capture does not say its arm angle; it belongs to no bin.")
    inputs = tuple(str(product.facts[INPUTS]).split("; ")) if INPUTS in product.facts else ()
    if white is not None and product.kind != "mueller":
        raise ProcessError(f"{product.path} holds xi0, which has no absolute scale. Leave --white away.")
    return ScatteringTable(
        names,
        product.header.wavelength_nm,
        layout,
        product.simulated,
        frames=frames,
        has_noise=has_noise,
        inputs=inputs if white is None else (*inputs, SCALE),
        scale_u=None if white is None else white.u,
    )


def _require_alike(source: Path, new: ScatteringTable, table: ScatteringTable) -> None:
    if abs(table.wavelength_nm - new.wavelength_nm) > 0.5:
        raise ProcessError(
            f"{source} is at {new.wavelength_nm:g} nm, the table at {table.wavelength_nm:g} nm; "
            "make one table for each wavelength."
        )
    if table.quantities != new.quantities:
        raise ProcessError(f"{source} has {new.quantities[0]}, the table has {table.quantities[0]}. Make one of each.")
    if table.scale_u != new.scale_u:
        raise ProcessError(f"{source}: the table has another absolute scale. Use the same --white for all images.")
    if (table.has_noise, bool(table.inputs)) != (new.has_noise, bool(new.inputs)):
        raise ProcessError(
            f"{source} or the images in the table have no noise, or no uncertainty of their instrument. Reduce all "
            "captures with a file that states it: process reduce --instrument FILE"
        )


def tabulate(
    sources: Sequence[Path],
    geometry_file: Path,
    layout: Layout,
    table: ScatteringTable | None = None,
    *,
    progress: Progress | None = None,
    white: WhiteReference | None = None,
) -> ScatteringTable:
    """Add the images of products to a table; a new one is made if none is given.

    Mueller matrices are turned into the renderer's axes pixel by pixel, so that pixels of one bin are alike. xi0
    products add their valid pixels; the variance of each has its covariances with the other pixels of the bin. Those of
    Mueller images are not averaged over neighbours. The mean of each direction of the instrument's uncertainty is in
    the table: the root of their sum of squares is the systematic uncertainty of a bin's mean. With a white reference
    the elements are a BRDF in 1/sr, and its scale is one more direction. Raises ProcessError: products of another kind
    or wavelength, without an arm angle, or simulated and measured mixed.
    """
    view = ViewingGeometry.load(geometry_file)
    for done, source in enumerate(sources, 1):
        with Product(source) as product:
            new = _table_for(product, layout, white)
            table = new if table is None else table
            _require_alike(source, new, table)
            # The images of another instrument go through a table of its own.
            target = table if new.inputs == table.inputs else new
            kind, omega_deg = product.kind, float(product.header.omega_deg or 0.0)
            # Neighbours share noise across the borders of blocks.
            blocks = product.row_blocks() if kind == "mueller" else [slice(0, product.shape[0])]
            for rows in blocks:
                image = view.at(omega_deg, *product.shape, block=rows)
                if not image.mask.any():
                    continue
                if kind == "mueller":
                    _add_mueller(target, image, product, rows=rows, white=white)
                else:
                    target.add(image.points.angles, _xi0_values(target, image, product), product.simulated)
            if target is not table:
                table.merge(target)
        if progress:
            progress(done, len(sources))
    if table is None:
        raise ProcessError("no product was given; there is nothing to tabulate.")
    return table
