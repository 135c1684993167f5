"""Frames of a polarization mosaic corrected to what ideal pixels would have seen (`process calibrate-mosaic` measures).

Source: Powell and Gruev, Opt. Express 21, 21039 (2013).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.reduction.mosaic.layout import MosaicError, MosaicLayout
from processing.reduction.mosaic.methods import bilinear
from processing.storage.products.product import Product

#: Rounds of the correction; each one leaves a few per cent of what was wrong before.
ROUNDS = 4


def read_response(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Response (3, rows, columns) of a product "analyzers"; MosaicError if it is for frames of another size."""
    with Product(path) as product:
        product.require("analyzers")
        if product.shape != shape:
            raise MosaicError(f"{path} is for frames of {product.shape}, these are {shape}.")
        return product.get("response")


def corrected_frame(
    frame: NDArray[np.float32], response: NDArray[np.float32], layout: MosaicLayout, analyzers: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Frame (rows, columns) that ideal pixels would have seen.

    Each pixel keeps its own counts, divided by its gain; what its analyzer adds over the ideal one is taken off
    with the polarization found around it.

    Parameters
    ----------
    response : (3, rows, columns), see `processing.calibration.mosaic`.
    analyzers : (channels, 3), the ideal rows that the rest of the reduction uses.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.where(response[0] > 0.05, 2 * response[0], np.nan)
    deviation = response / gain
    for k, (r, c) in enumerate(layout.offsets):
        deviation[:, r::2, c::2] -= analyzers[k].astype(np.float32)[:, None, None]
    even = (frame / gain).astype(np.float32)
    solve = np.linalg.pinv(analyzers).astype(np.float32)
    out = even
    for _ in range(ROUNDS):
        s = np.tensordot(solve, bilinear.channels(out, layout), axes=1)
        out = np.asarray(even - np.einsum("sxy,sxy->xy", deviation, s), dtype=np.float32)
    return out
