"""Material constants from products of `process reduce`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion

from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry
from processing.geometry.viewing import ViewingGeometry
from processing.polarization.cloude import xi0_and_dominant
from processing.reflectance.material_fit import MaterialFit, fit_intensities, fit_mueller
from processing.storage.images import StokesImage
from processing.storage.product import Product

#: At most so many pixels of each image go into a fit.
PIXELS = 3000
#: Pixels nearer than this to the outline are left out: the default demosaicing reaches across it.
BORDER_PX = 4


def fit_products(sources: Sequence[Path], geometry_file: Path) -> tuple[MaterialFit, float, bool]:
    """Fit Mueller products (least squares) or Stokes products (linear correlation): fit, wavelength, simulated.

    Raises
    ------
    ProcessError : products of several kinds or wavelengths, simulated and measured mixed, no arm angle.
    """
    kinds, simulated, wavelengths = set(), set(), set()
    for source in sources:
        with Product(source) as product:
            product.require("mueller", "stokes")
            kinds.add(product.kind)
            simulated.add(product.simulated)
            wavelengths.add(product.header.wavelength_nm)
            if product.header.omega_deg is None:
                raise ProcessError(f"{source}: the capture does not say its arm angle.")
    for what, values in (("kinds", kinds), ("wavelengths", wavelengths)):
        if len(values) > 1:
            raise ProcessError(f"one fit takes products of one of these {what} only: {sorted(map(str, values))}")
    if len(simulated) > 1:
        raise ProcessError("simulated and measured products were given together; fit them one by one.")
    view = ViewingGeometry.load(geometry_file)
    fit = _fit_mueller(sources, view) if kinds == {"mueller"} else _fit_stokes(sources, view)
    return fit, float(wavelengths.pop()), simulated.pop()


def _fit_mueller(sources: Sequence[Path], view: ViewingGeometry) -> MaterialFit:
    parts, matrices = [], []
    for source in sources:
        with Product(source) as product:
            points, index = _sample(view, product)
            parts.append(points)
            matrices.append(product.get("mueller").reshape(16, -1)[:, index].T.reshape(-1, 4, 4).astype(float))
    m = np.concatenate(matrices)
    xi0, m0 = xi0_and_dominant(m)
    return fit_mueller(_joined(parts), m0, xi0, m[:, 0, 0], max_pixels=len(m))


def _fit_stokes(sources: Sequence[Path], view: ViewingGeometry) -> MaterialFit:
    parts, signals, variances = [], [], []
    w = None
    for source in sources:
        with Product(source) as product:
            points, index = _sample(view, product)
        image = StokesImage.load(source)
        if w is not None and not np.allclose(w, image.w):
            raise ProcessError(f"{source} was taken with another generator state than the first product.")
        w = image.w
        parts.append(points)
        stokes = image.values.reshape(3, -1)[:, index].astype(float)
        covariance = image.covariance.reshape(-1, 3, 3)[index].astype(float)
        signals.append(image.analyzers @ stokes)
        variances.append(np.einsum("cs,nst,ct->cn", image.analyzers, covariance, image.analyzers, optimize=True))
    if w is None:
        raise ProcessError("no product was given; there is nothing to fit.")
    joined = _joined(parts)
    variance = np.concatenate(variances, axis=1)
    return fit_intensities(joined, np.concatenate(signals, axis=1), w, variance, max_pixels=variance.shape[1])


def _sample(view: ViewingGeometry, product: Product) -> tuple[ScatteringGeometry, np.ndarray]:
    # Lit and reduced pixels, evenly thinned: geometry and flat index.
    image = view.at(float(product.header.omega_deg or 0.0), *product.shape)
    # Pixels on the outline mix object and background, in a mosaic most of all.
    inner = binary_erosion(image.mask, iterations=BORDER_PX)
    good = np.flatnonzero(inner[image.mask] & (product.get("pixel_mask")[image.mask] == 0))
    if good.size == 0:
        raise ProcessError(f"{product.path}: no good pixel sees the object; check the geometry file.")
    chosen = good[np.linspace(0, good.size - 1, min(good.size, PIXELS)).astype(np.int64)]
    return image.points[chosen], np.flatnonzero(image.mask)[chosen]


def _joined(parts: Sequence[ScatteringGeometry]) -> ScatteringGeometry:
    vectors = (np.concatenate([getattr(p, name) for p in parts]) for name in ("normal", "to_source", "to_camera"))
    return ScatteringGeometry(*vectors)
