"""What honest error bars cost: xi0 and all quantities with first-order error bars alone, a table without any."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from measuring import SMALL, Task, seconds
from noisy_images import five_samples, noisy_image
from reduction_tasks import INSTRUMENT, ROOT, frames_of_a_ball, write_frames

from processing.instrument.model import InstrumentModel
from processing.maps import quantities, tables
from processing.maps.xi0 import eigenvalue_block
from processing.polarization import gradients
from processing.polarization.quantities import PAPER_PAIRS
from processing.reduction.mueller import reduce_mueller
from processing.reflectance.tables import ScatteringTable
from processing.steps.table import Tabulation
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step

PIXELS = 40_000
#: Honest error bars may take this much longer.
AT_MOST = 1.3
#: Of a table: uncertain inputs of the instrument, in degrees.
U = {
    **{f"{end}_retarder.retardance_deg": 0.3 for end in ("psg", "psa")},
    **{f"{end}.azimuth_deg": 0.1 for end in ("psg_retarder", "psa_retarder", "analyzer")},
}


def _image() -> MuellerImage:
    matrix = five_samples()["triply degenerate"]
    return noisy_image(np.tile(matrix, (PIXELS, 1, 1)), 2000.0, 1)


def _against(peer: str, without: Callable[[], object], name: str, ours: Callable[[], object]) -> Task:
    """A task that may take `AT_MOST` of the time of the same `without` honest error bars."""
    return Task(name, None, ours, {peer: lambda: seconds(without)}, (peer, AT_MOST))


def xi0() -> Task:
    """`process xi0`: noise taken off, intervals that cover."""
    image = _image()

    def first_order() -> None:
        # An image remembers its variances; each of the two works them out.
        fresh = replace(image)
        found = gradients.coherency(fresh.matrices.astype(float))["coherency_eigenvalues"]
        np.sqrt(fresh.variance_of(found.gradient[0]))

    name = f"xi0 with intervals, {PIXELS} pixels"
    return _against("first order alone", first_order, name, lambda: eigenvalue_block(replace(image)))


def all_quantities() -> Task:
    """`process quantities`: noise taken off magnitudes and eigenvalues, an interval in every pixel."""
    image = _image()

    def ours() -> None:
        quantities.quantities_block(replace(image), (), PAPER_PAIRS)

    def first_order() -> None:
        with mock.patch.object(quantities, "_set_intervals"):
            ours()

    return _against("first order alone", first_order, f"all quantities with intervals, {PIXELS} pixels", ours)


def table(folder: Path) -> Task:
    """`process table`, file to file: noise and five uncertain inputs of the instrument, with means and variances."""
    write_frames(folder / "ball.h5", SMALL, frames_of_a_ball, omega_deg=35.0)
    model = InstrumentModel.load(INSTRUMENT).at(662).model_copy(update={"stderr": U})
    image = folder / "ball.mueller.h5"
    with Capture(folder / "ball.h5") as capture:
        reduce_mueller(capture, model, image, (Step("reduce", {}),))
    geometry = ROOT / "configs/geometries/one_inch_sphere.yaml"
    step = Tabulation((image,), geometry, folder / "table.h5", "renderer")

    def means() -> None:
        alone = ScatteringTable(tables.MUELLER, 662, "renderer", True, frames="renderer")
        with mock.patch.object(tables, "_table_for", return_value=alone):
            step.make(overwrite=True)

    name = f"process table with noise and {len(U)} uncertain inputs, {SMALL[0]} x {SMALL[1]}"
    return _against("means and variances alone", means, name, lambda: step.make(overwrite=True))
