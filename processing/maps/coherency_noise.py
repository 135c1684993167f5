"""Noise of the coherency matrices of a Mueller image, from the image's own covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.eigenvalue_noise import TRIPLE, EigenvalueNoise
from processing.polarization.quantities import deviation_from_td
from processing.polarization.triply_degenerate import mueller_matrix
from processing.storage.products.images import MuellerImage


def coherency_noise(image: MuellerImage) -> EigenvalueNoise:
    """Noise of the coherency matrix about the dominant process of each pixel.

    To first order d xi0 = <dM, m0 - 4 xi0 e00> / (4 m00), m0 being the dominant process.
    """
    m0 = xi0_and_dominant(image.matrices)[1]
    process = np.asarray(m0, dtype=np.float32).reshape(*m0.shape[:2], 16)
    m00 = image.values[0, 0].astype(float)
    alone = process.copy()
    alone[..., 0] -= 1
    with np.errstate(divide="ignore", invalid="ignore"):
        whole, known_m00 = image.variance_of(process), image.variance_of(alone)
        brightness = np.square(image.errors[0, 0].astype(float))
        row = image.product_of(TRIPLE, process) / m00**2
        total = np.square(image.errors).sum(axis=(0, 1)) / (4 * m00**2)
        with_m00 = (whole - known_m00 - brightness) / (8 * m00**2)
        along = np.sqrt(known_m00) / (4 * m00)
        return EigenvalueNoise.of(
            total, row, whole / (4 * m00) ** 2, along, m00=np.sqrt(brightness) / np.abs(m00), with_m00=with_m00
        )


def largest_deviation_by_noise(image: MuellerImage) -> NDArray[np.float64]:
    """The largest deviation of xi1, xi2, xi3 from their mean that noise alone makes, (rows, columns).

    One draw a pixel, always the same: of the triply degenerate matrix of its dominant process, with the image's noise.
    """
    xi0, m0 = xi0_and_dominant(image.matrices)
    even = mueller_matrix(m0, xi0, image.values[0, 0])
    drawn = image.drawn_noise(np.random.default_rng(0)).T.reshape(*image.mask.shape, 4, 4)
    return np.asarray(np.abs(deviation_from_td(coherency_eigenvalues(even + drawn))).max(axis=-1), dtype=float)
