"""Noise of the coherency matrices of a Mueller image, from the image's own covariance."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.eigenvalue_noise import TRIPLE, EigenvalueNoise
from processing.polarization.magnitude import NORMAL_95
from processing.polarization.quantities import deviation_from_td
from processing.polarization.triply_degenerate import mueller_matrix
from processing.storage.products.images import MuellerImage

#: A longer or shorter one is not of second order.
MOST = 2.0


def coherency_noise(image: MuellerImage) -> EigenvalueNoise:
    """Noise of the coherency matrix about the dominant process of each pixel.

    To first order d xi0 = <dM, m0 - 4 xi0 e00> / (4 m00), m0 being the dominant process.
    """
    xi0, m0 = xi0_and_dominant(image.matrices)
    process = np.asarray(m0, dtype=np.float32).reshape(*m0.shape[:2], 16)
    m00 = image.values[0, 0].astype(float)
    alone = process.copy()
    alone[..., 0] -= 1
    with np.errstate(divide="ignore", invalid="ignore"):
        of_process, known_m00 = image.variance_of(process), image.variance_of(alone)
        brightness = np.square(image.errors[0, 0].astype(float))
        row = image.product_of(TRIPLE, process) / m00**2
        total = np.square(image.errors).sum(axis=(0, 1)) / (4 * m00**2)
        with_m00 = (of_process - known_m00 - brightness) / (8 * m00**2)
        along = np.sqrt(known_m00) / (4 * m00)
        noise = EigenvalueNoise.of(
            total, row, of_process / (4 * m00) ** 2, along, m00=np.sqrt(brightness) / np.abs(m00), with_m00=with_m00
        )
        below, above = _stretches(image, xi0, process)
    return replace(noise, below=below, above=above)


def _stretches(
    image: MuellerImage, xi0: NDArray[np.floating], process: NDArray[np.float32]
) -> list[NDArray[np.float64]]:
    """How far xi0 falls and rises within the ellipsoid of 1.96 errors, over 1.96 of its errors to first order.

    Noise that makes xi0 larger also turns the dominant process, to where the noise is another one.
    """
    slope = process.copy()
    slope[..., 0] -= 4 * xi0
    moved = image.covariance_with(slope)
    error = np.sqrt(np.einsum("xyi,xyi->xy", moved, slope))
    step = (NORMAL_95 * moved / error[..., None]).reshape(*xi0.shape, 4, 4)
    matrices, reach = image.matrices.astype(float), NORMAL_95 * error / (4 * np.abs(image.values[0, 0]))
    ends = [np.abs(xi0_and_dominant(matrices + side * step)[0] - xi0) / reach for side in (-1, 1)]
    return [np.where(np.isfinite(end), np.clip(end, 1 / MOST, MOST), 1.0) for end in ends]


def largest_deviation_by_noise(image: MuellerImage) -> NDArray[np.float64]:
    """The largest deviation of xi1, xi2, xi3 from their mean that noise alone makes, (rows, columns).

    One draw a pixel, always the same: of the triply degenerate matrix of its dominant process, with the image's noise.
    """
    xi0, m0 = xi0_and_dominant(image.matrices)
    even = mueller_matrix(m0, xi0, image.values[0, 0])
    drawn = image.drawn_noise(np.random.default_rng(0)).T.reshape(*image.mask.shape, 4, 4)
    return np.asarray(np.abs(deviation_from_td(coherency_eigenvalues(even + drawn))).max(axis=-1), dtype=float)
