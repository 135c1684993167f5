"""What honest error bars cost: xi0 and all quantities beside the same with first-order error bars alone."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
from measuring import Task, seconds
from noisy_images import five_samples, noisy_image

from processing.maps import quantities
from processing.maps.xi0 import eigenvalue_block
from processing.polarization import gradients
from processing.polarization.quantities import PAPER_PAIRS
from processing.storage.products.images import MuellerImage

PIXELS = 40_000
#: Honest error bars may take this much longer.
AT_MOST = 1.3


def _image() -> MuellerImage:
    matrix = five_samples()["triply degenerate"]
    return noisy_image(np.tile(matrix, (PIXELS, 1, 1)), 2000.0, 1)


def xi0() -> Task:
    """`process xi0`: noise taken off, intervals that cover."""
    image = _image()

    def first_order() -> None:
        # An image remembers its variances; each of the two works them out.
        fresh = replace(image)
        found = gradients.coherency(fresh.matrices.astype(float))["coherency_eigenvalues"]
        np.sqrt(fresh.variance_of(found.gradient[0]))

    task = Task(f"xi0 with intervals, {PIXELS} pixels", None, lambda: eigenvalue_block(replace(image)))
    task.peers["first order alone"] = lambda: seconds(first_order)
    task.at_most = ("first order alone", AT_MOST)
    return task


def all_quantities() -> Task:
    """`process quantities`: noise taken off magnitudes and eigenvalues, an interval in every pixel."""
    image = _image()

    def first_order() -> None:
        with mock.patch.object(quantities, "_set_intervals"):
            quantities.quantities_block(replace(image), (), PAPER_PAIRS)

    task = Task(
        f"all quantities with intervals, {PIXELS} pixels",
        None,
        lambda: quantities.quantities_block(replace(image), (), PAPER_PAIRS),
    )
    task.peers["first order alone"] = lambda: seconds(first_order)
    task.at_most = ("first order alone", AT_MOST)
    return task
