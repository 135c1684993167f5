"""Reduce a capture to a Mueller image: black, flat, exposure, one inversion for all pixels, standard errors.

Row blocks keep memory constant; the product can be resumed.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.instrument.model import InstrumentModel
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.effects_of_capture import references
from processing.reduction.exclusions import Exclusions
from processing.reduction.facts import mueller_facts
from processing.reduction.measurement_matrix import exposure_fact, short_list
from processing.reduction.mueller_reduction import Choice, MuellerReduction
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.base import Solver
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.product import Step
from processing.storage.products.product_writer import ProductWriter

#: Called with (rows done, rows in all).
Progress = Callable[[int, int], None]

BLOCK_PIXELS = 1 << 18


def reduce_mueller(
    capture: Capture,
    model: InstrumentModel,
    out: Path,
    steps: tuple[Step, ...],
    *,
    correction: CountCorrection | None = None,
    choice: Choice | None = None,
    left_out: Exclusions | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the Mueller image of a capture; returns the facts that the product holds.

    Parameters
    ----------
    model : resolved at the capture's wavelength.
    correction : black, flat and masks; default: what the capture itself offers.
    choice : weighting, covariance, physical estimate, noise; default: plain.
    left_out : states and intensities that are no measurement of the sample; its bad pixels belong into `correction`.

    Raises
    ------
    NotDetermined : W has a lower rank than states of this instrument can have.
    CaptureError : angles or frames are missing or not finite.
    """
    reduction = MuellerReduction.of(capture, model, correction, choice, left_out=left_out)
    noise, levels, planes = reduction.noise, reduction.levels, reduction.planes
    solver = reduction.solver(capture)
    with ProductWriter(
        out, "mueller", capture.header, capture.frame_shape, planes=planes, steps=steps, overwrite=overwrite
    ) as product:
        product.array(
            "measurement_matrix", reduction.w, "", "W (state, channel, 16): intensity = W . vec(M), row-major"
        )
        if levels is not None:
            product.array("source_level", levels.relative, "", "level of the source in each state over its mean")
            product.array("source_level_errors", levels.stderr, "", "standard errors of source_level")
        _store_noise(product, noise, solver)
        # HDF5 lets the interpreter go while it writes: one block is stored while the next is solved.
        with ThreadPoolExecutor(1) as storing:
            stored: Future[None] | None = None
            for rows in capture.row_blocks(BLOCK_PIXELS):
                if rows.stop > product.rows_done:
                    block = reduction.block(solver, rows)
                    if stored:
                        stored.result()
                    stored = storing.submit(product.write, rows, **block)
                if progress:
                    progress(rows.stop, capture.frame_shape[0])
            if stored:
                stored.result()
        try:
            facts = mueller_facts(
                reduction.inversion,
                noise,
                reduction.correction,
                product,
                states=len(reduction.states),
                weighted=reduction.choice.weighted,
            )
        except CaptureError as error:
            product.discard()
            raise CaptureError(f"{capture.path}: {error}{_without_numbers(capture, reduction.states)}") from error
        facts["warnings"] += reduction.warnings
        facts |= _further_facts(reduction) | references(capture, model) | exposure_fact(capture, reduction.states)
        facts |= reduction.systematic.store(product) if reduction.systematic is not None else {}
        if levels is not None:
            facts["source"] = levels.text
        product.seal(facts)
    return facts


def _further_facts(reduction: MuellerReduction) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    if reduction.sent is not None:
        facts["determined"] = reduction.sent.named
    if reduction.choice.physical:
        facts["physical_estimate"] = f"{reduction.choice.physical}, as mueller_physical beside the plain one"
    return facts


def _store_noise(product: ProductWriter, noise: NoiseModel | None, solver: Solver) -> None:
    # variance of intensity n = slope[n] * signal + floor[n]; NaN: estimated from the residual.
    nothing = np.full(len(solver.repeats), np.nan)
    slope = noise.slope / solver.repeats if noise else nothing
    product.array("noise_slope", slope, "count", "shot noise: variance a signal count, for each row of W")
    floor = solver.intensity_floor if noise else nothing
    product.array("noise_floor", floor, "count2", "variance without light, for each row of W")
    dark = solver.dark_errors
    if dark.any():
        text = "errors (element, mean of darks) of mueller that one standard error of each mean of dark frames makes"
        product.array("dark_errors", dark, "count", text)


def _without_numbers(capture: Capture, states: NDArray[np.int64]) -> str:
    """Which states have frames without a single number, as the end of a message."""
    empty = np.array([k for k in states if not np.isfinite(capture.frames(int(k))).any()], dtype=np.int64)
    if not empty.size:
        return ""
    return f" State(s) {short_list(empty)} hold no number at all: take them again, or import without them."
