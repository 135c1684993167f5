"""The planes of a Mueller product: the planes of every image of Mueller matrices in addition to the matrices."""

import numpy as np

from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane

MUELLER_PLANES = {
    "mueller": Plane((4, 4), "count", "Mueller matrix, row-major, not normalized"),
    "mueller_errors": Plane((4, 4), "count", "standard errors of mueller"),
    "residual_rms": Plane((), "count", "root mean square over the states of intensity minus fit"),
    "pixel_flags": Plane((), "", f"0 = good; bits: {Mask.meaning()}", np.uint8),
}
