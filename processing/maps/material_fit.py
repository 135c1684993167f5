"""Material constants from products of `process reduce`."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from processing.doors import require_distinct
from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry
from processing.geometry.viewing import ViewingGeometry
from processing.maps.stokes_vector import moves_of_light
from processing.reduction.sent_light import light_of, sent_parts, sent_rows
from processing.reduction.systematic import Systematic
from processing.reflectance.fitted_constants import MaterialFit
from processing.reflectance.material_fit import fit_values
from processing.reflectance.plastic_fit import fit_plastic
from processing.storage.products.images import SMALLEST, MuellerImage, StokesImage
from processing.storage.products.product import Product


class _Data(NamedTuple):
    """Pixels of one product or of several: values (K, N), rows (K, 16) and covariance (N, K, K) of the values.

    Attributes
    ----------
    inputs, moved : uncertain inputs of the instrument, and values and rows with one standard uncertainty of each.
    """

    points: ScatteringGeometry
    values: NDArray[np.float64]
    rows: NDArray[np.float64]
    covariance: NDArray[np.float64]
    inputs: tuple[str, ...]
    moved: list[tuple[NDArray[np.float64], NDArray[np.float64]]]


#: At most so many pixels of each image go into a fit.
PIXELS = 3000
#: Pixels nearer than this to the outline are left out: the default demosaicing reaches across it.
BORDER_PX = 4
#: Two coefficients of each pixel are fitted with the constants: as many elements leave nothing over.
LEAST_VALUES = 3
#: Difference of rows that is rounding of what the axes read.
ALIKE = 1e-4


def fit_products(
    sources: Sequence[Path], geometry_file: Path, *, correlation: bool = False, kind: str = "polarized_diffuse"
) -> tuple[MaterialFit, float, bool]:
    """Fit Mueller or Stokes products, see `fit_values` and `fit_plastic`: fit, wavelength, simulated.

    Raises ProcessError: a kind of model that is not fitted; products of several kinds or wavelengths, simulated and
    measured mixed, no arm angle.
    """
    if kind not in ("polarized_diffuse", "rough_plastic"):
        raise ProcessError(f"--kind {kind}: constants of polarized_diffuse and of rough_plastic can be fitted.")
    if correlation and kind != "polarized_diffuse":
        raise ProcessError("--correlation belongs to polarized_diffuse. Leave it away.")
    require_distinct(sources)
    kinds, simulated, wavelengths = set(), set(), set()
    for source in sources:
        with Product(source) as product:
            product.require("mueller", "stokes")
            kinds.add(product.kind)
            simulated.add(product.simulated)
            wavelengths.add(product.header.wavelength_nm)
            if product.header.omega_deg is None:
                raise ProcessError(f"{source}: the capture does not say its arm angle.")
    for name, values in (("kinds", kinds), ("wavelengths", wavelengths)):
        if len(values) > 1:
            raise ProcessError(f"one fit takes products of one of these {name} only: {sorted(map(str, values))}")
    if len(simulated) > 1:
        raise ProcessError("simulated and measured products were given together; fit them one by one.")
    view = ViewingGeometry.load(geometry_file)
    read = _of_mueller if kinds == {"mueller"} else _of_stokes
    each = [read(source, view) for source in sources]
    first = each[0]
    for source, data in zip(sources, each, strict=True):
        if data.rows.shape != first.rows.shape or not np.allclose(data.rows, first.rows, atol=ALIKE):
            raise ProcessError(f"{source} determines something else than the first product, or under other light.")
        if data.inputs != first.inputs:
            raise ProcessError(
                f"{source} was reduced with other uncertain values than {sources[0]}. Reduce all captures with one "
                "file: process reduce --instrument FILE"
            )
    if len(first.rows) < LEAST_VALUES:
        raise ProcessError(f"a fit needs {LEAST_VALUES} elements of M or more; see what `process reduce` determined.")
    moved = [
        (np.concatenate([data.moved[k][0] for data in each], axis=1), first.moved[k][1])
        for k in range(len(first.inputs))
    ]
    fit_of = fit_plastic if kind == "rough_plastic" else partial(fit_values, correlation=correlation)
    fit = fit_of(
        _join([data.points for data in each]),
        np.concatenate([data.values for data in each], axis=1),
        first.rows,
        np.concatenate([data.covariance for data in each]),
        max_pixels=sum(len(data.covariance) for data in each),
        moved=moved,
    )
    return fit, float(wavelengths.pop()), simulated.pop()


def _of_mueller(source: Path, view: ViewingGeometry) -> _Data:
    with Product(source) as product:
        points, index = _sample(view, product)
        image, systematic = MuellerImage.of(product).at(index), Systematic.of_product(product)
    values, rows = determined_values(image)
    moved, inputs = [], () if systematic is None else systematic.labels
    if systematic is not None:
        moves = moves_of_light(systematic, image).reshape(len(inputs), 4, 4, -1)
        for direction, move in zip(systematic.directions, moves, strict=True):
            if image.sent is None:
                moved.append((values + move.reshape(16, -1)[image.is_determined], rows))
            else:
                is_sent = sent_parts(image.sent)
                moved.append((values + move[is_sent, 0], sent_rows(direction.rows)[is_sent]))
    return _Data(points, values, rows, covariance_by_light(image, rows), inputs, moved)


def determined_values(image: MuellerImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Quantities that a product determines, (K, pixels), and the rows (K, 16) that map M to them.

    Elements of M, or the Stokes vector that is sent back where no element is determined alone.
    """
    if image.sent is None:
        return image.values.reshape(16, -1)[image.is_determined].astype(float), np.eye(16)[image.is_determined]
    is_sent = sent_parts(image.sent)
    return image.sent.reshape(4, -1)[is_sent].astype(float), sent_rows(image.w)[is_sent]


def covariance_by_light(image: MuellerImage, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance (pixels, K, K) of rows (K, 16) . vec(M), as if the sample did not polarize.

    So that it follows no element's noise.
    """
    level = image.values[0, 0] if image.sent is None else image.sent[0]
    light = np.maximum(level.reshape(-1).astype(float), 0.0)
    if np.isnan(image.noise_slope).any():
        variance = np.ones((len(image.w), light.size))
    else:
        # A floor of nothing, in the dark, would be an infinite weight.
        floor = np.maximum(image.noise_floor, 1e-3 * image.noise_slope**2)
        variance = np.outer(image.noise_slope * image.w[:, 0], light) + floor[:, None]
    if image.facts["weighted"]:
        information = np.einsum("np,ni,nj->pij", 1 / variance, image.w, image.w, optimize=True)
        return np.asarray(rows @ np.linalg.pinv(information, rcond=SMALLEST**2, hermitian=True) @ rows.T)
    solve = rows @ np.linalg.pinv(image.w, rcond=SMALLEST)
    return np.asarray(np.einsum("np,in,jn->pij", variance, solve, solve, optimize=True))


def _of_stokes(source: Path, view: ViewingGeometry) -> _Data:
    with Product(source) as product:
        points, index = _sample(view, product)
        systematic = Systematic.of_product(product)
    image = StokesImage.load(source)
    values = image.values.reshape(3, -1)[:, index].astype(float)
    covariance = image.covariance.reshape(-1, 3, 3)[index].astype(float)
    moved, inputs = [], () if systematic is None else systematic.labels
    if systematic is not None:
        for direction, move in zip(systematic.directions, systematic.moves(values), strict=True):
            moved.append((values + move, stokes_rows(direction.rows)))
    return _Data(points, values, stokes_rows(image.w), covariance, inputs, moved)


def stokes_rows(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (3, 16) that lead from M to the linear Stokes vector that analyzers without S3 find, of W (channels, 16)."""
    light = light_of(w)
    analyzers = (w.reshape(-1, 4, 4) @ light)[:, :3] / (light @ light)
    return np.asarray(np.linalg.pinv(analyzers) @ w)


def _sample(view: ViewingGeometry, product: Product) -> tuple[ScatteringGeometry, np.ndarray]:
    # Lit and reduced pixels, evenly thinned: geometry and flat index.
    image = view.at(float(product.header.omega_deg or 0.0), *product.shape)
    # Pixels on the outline mix object and background, in a mosaic most of all.
    inner = binary_erosion(image.mask, iterations=BORDER_PX)
    good = np.flatnonzero(inner[image.mask] & (product.get("pixel_flags")[image.mask] == 0))
    if good.size == 0:
        raise ProcessError(f"{product.path}: no good pixel sees the object; check the geometry file.")
    chosen = good[np.linspace(0, good.size - 1, min(good.size, PIXELS)).astype(np.int64)]
    return image.points[chosen], np.flatnonzero(image.mask)[chosen]


def _join(parts: Sequence[ScatteringGeometry]) -> ScatteringGeometry:
    vectors = (np.concatenate([getattr(p, name) for p in parts]) for name in ("normal", "to_source", "to_camera"))
    return ScatteringGeometry(*vectors)
