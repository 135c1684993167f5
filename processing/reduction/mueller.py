"""Reduce a capture to a Mueller image: black, flat, exposure, one inversion for all pixels, standard errors.

W is built from the angles read back. Row blocks keep memory constant; the product can be resumed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.instrument.changes import Changes
from processing.instrument.determined import determined_basis, determined_elements
from processing.instrument.model import InstrumentModel
from processing.polarization.physical import nearest
from processing.reduction.counts_to_signal import BlockReader, Correction
from processing.reduction.cut_off import without_cut_off
from processing.reduction.effects_of_capture import (
    CountsCorrection,
    capture_changes,
    counts_correction,
    extra_retardance,
    references,
    with_extra,
)
from processing.reduction.facts import mueller_facts
from processing.reduction.instrument_of_capture import require_belongs, require_one_colour
from processing.reduction.left_out import LeftOut
from processing.reduction.noise import NoiseModel, noise_of
from processing.reduction.sample_states import sample_states
from processing.reduction.sent_light import PLANES as SENT_PLANES
from processing.reduction.sent_light import SentLight
from processing.reduction.solvers.field import Field, FieldSolver
from processing.reduction.solvers.inversion import ELEMENTS, Inversion
from processing.reduction.solvers.plain import MuellerSolver
from processing.reduction.source_level import LeveledSource, SourceLevels
from processing.reduction.systematic import Systematic
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.mueller_planes import MUELLER_PLANES
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane, ProductWriter, Step

if TYPE_CHECKING:
    from processing.reduction.solvers.weighted import WeightedSolver

    Solver: TypeAlias = MuellerSolver | WeightedSolver | FieldSolver

#: Called with (rows done, rows in all).
Progress = Callable[[int, int], None]

BLOCK_PIXELS = 1 << 18

CHI_SQUARE = Plane((), "", "squared residual over what the noise model expects; 1 if the model is complete")
_LEFT = "what is uncertain in the instrument; it does not average"
SYSTEMATIC = {
    "mueller_systematic": Plane(
        (4, 4), "count", f"systematic standard errors of mueller (of M/m00, times m00): {_LEFT}"
    )
}
SENT_SYSTEMATIC = {
    "stokes_systematic": Plane((4,), "count", f"systematic standard errors of stokes (of S/S0, times S0): {_LEFT}")
}
COVARIANCE = Plane(
    (ELEMENTS * (ELEMENTS + 1) // 2,),
    "count2",
    "covariance of mueller, lower triangle row by row: 00, 10, 11, 20, 21, 22, ...",
)
PHYSICAL = {
    "nearest": Plane((4, 4), "count", "physical Mueller matrix nearest to mueller (Frobenius norm)"),
    "likelihood": Plane((4, 4), "count", "physical Mueller matrix of highest likelihood"),
}


@dataclass(frozen=True)
class Choice:
    """How to reduce.

    Attributes
    ----------
    weighted : weigh each intensity by its noise, pixel by pixel; else equal weights.
    covariance : store the full 16 x 16 covariance of each pixel (needs `weighted`).
    physical : "nearest", "likelihood" (needs `weighted`) or None: a physical estimate beside the plain one.
    noise : of the camera, where it is known better than by the capture's header.
    """

    weighted: bool = False
    covariance: bool = False
    physical: str | None = None
    noise: NoiseModel | None = None

    def __post_init__(self) -> None:
        if self.physical not in (None, *PHYSICAL):
            raise ProcessError(f"physical estimate {self.physical!r} is none of {', '.join(PHYSICAL)}")
        if not self.weighted and (self.covariance or self.physical == "likelihood"):
            raise ProcessError("a stored covariance and the most likely physical matrix need the weighted estimate")

    def solver(self, plain: MuellerSolver, field: Field | None = None) -> Solver:
        """The solver that the choice asks for; `field` where W varies over the image."""
        if field is not None:
            if self.weighted:
                raise ProcessError("--weighted is not available for an instrument with field_retardance; leave it out")
            return FieldSolver(plain, field)
        if not self.weighted:
            return plain
        # Imported here: its compiled loops make every start half a second longer.
        from processing.reduction.solvers.weighted import WeightedSolver

        return WeightedSolver(plain, self.covariance, self.physical == "likelihood")

    def planes(self, known_noise: bool) -> dict[str, Plane]:
        """Datasets of the product."""
        planes = dict(MUELLER_PLANES)
        if known_noise:
            planes["reduced_chi_square"] = CHI_SQUARE
        if self.covariance:
            planes["mueller_covariance"] = COVARIANCE
        if self.physical:
            planes["mueller_physical"] = PHYSICAL[self.physical]
        return planes


def angles_of(capture: Capture, model: InstrumentModel, states: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
    """Angles as read back, axis name to (states,), in degrees.

    Raises
    ------
    CaptureError : the capture is not of this instrument, or of several colours, or an axis has no angle in some state.
    """
    require_one_colour(capture)
    angles = {name: value[states] for name, value in capture.angles_deg.items()}
    require_belongs(capture, model)
    read = [np.isfinite(angles[axis]) for axis in model.axes]
    bad = ~np.all([np.ones(len(states), dtype=bool), *read], axis=0)
    if np.any(bad):
        raise CaptureError(
            f"{capture.path}: no read-back angle in state(s) {_some(states[bad])}; they cannot be reduced."
        )
    return angles


def measurement_matrix(
    capture: Capture, model: InstrumentModel, states: NDArray[np.int64], changes: Changes | None = None
) -> NDArray[np.float64]:
    """W (states, channels, 16) from the read-back angles, rows scaled with the exposure (longest = 1).

    `changes` is what the model's effects do to this capture (`effects_of_capture.capture_changes`).

    Raises
    ------
    CaptureError : see `angles_of`.
    """
    w = model.rows(angles_of(capture, model, states), changes)
    return w * relative_exposure(capture, states)[:, None, None]


def field_of(
    capture: Capture,
    model: InstrumentModel,
    states: NDArray[np.int64],
    changes: Changes | None,
    level: NDArray[np.float64] | None = None,
) -> Field | None:
    """W where retardances vary over the image; None where W is the same everywhere.

    `level` (states,) : of the source.
    """
    if changes is None or not changes.field_retardance_rad:
        return None

    def matrix(extra: NDArray[np.float64]) -> NDArray[np.float64]:
        w = measurement_matrix(capture, model, states, with_extra(changes, extra))
        return (w if level is None else w * level[:, None, None]).reshape(-1, 16)

    return Field(matrix, lambda x, y: extra_retardance(changes, x, y))


def relative_exposure(capture: Capture, states: NDArray[np.int64]) -> NDArray[np.float64]:
    """Exposure of each state over the longest one, (states,); 1 where the capture does not know exposures."""
    exposure = capture.column("exposure_s")[states].astype(float)
    if not np.any(np.isfinite(exposure)):
        return np.ones(len(states))
    if not np.all(np.isfinite(exposure)) or np.any(exposure <= 0):
        raise CaptureError(
            f"{capture.path}: exposure_s is given for some states only, or not positive; give it for all or none."
        )
    return np.asarray(exposure / exposure.max())


def reduce_mueller(
    capture: Capture,
    model: InstrumentModel,
    out: Path,
    steps: tuple[Step, ...],
    correction: Correction | None = None,
    choice: Choice | None = None,
    left_out: LeftOut | None = None,
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
    left_out = left_out or LeftOut()
    every = sample_states(capture)
    states, cut_off = without_cut_off(capture, left_out.rest_of(every, capture.path))
    cut_off = [*left_out.warnings, *cut_off]
    changes = capture_changes(capture, model, states)
    correction = correction or Correction.of(capture)
    struck = _among(left_out.hits, every, states)
    reader = BlockReader(capture, states, correction, counts_correction(changes, model), struck)
    basis = determined_basis(model)
    source = LeveledSource.of(reader, model, basis, varies=changes is not None and bool(changes.field_retardance_rad))
    w, levels = source.leveled(measurement_matrix(capture, model, states, changes))
    what = "".join(f"{text}: " for text in (capture.path, *cut_off))
    inversion = Inversion.of(w.reshape(-1, 16), what, basis, levels.spent if levels else 0.0)
    choice = choice or Choice()
    noise = choice.noise or noise_of(capture, states)
    if inversion.rank < ELEMENTS and (choice.physical or (changes is not None and changes.field_retardance_rad)):
        raise ProcessError(
            f"{capture.path}: instrument {model.name!r} determines {inversion.rank} of 16 numbers; --physical and "
            "field_retardance need all of them. Leave them away."
        )
    field = field_of(capture, model, states, changes, levels.relative if levels else None)
    solver = choice.solver(MuellerSolver(inversion, reader, noise), field)
    planes = choice.planes(known_noise=noise is not None)
    sent = SentLight.of(inversion)
    planes |= SENT_PLANES if sent is not None else {}
    systematic = _systematic(capture, model, states, inversion, source)
    if systematic is not None:
        planes |= SYSTEMATIC if sent is None else SENT_SYSTEMATIC
    with ProductWriter(out, "mueller", capture.header, capture.frame_shape, planes, steps, overwrite) as product:
        product.array("measurement_matrix", w, "", "W (state, channel, 16): intensity = W . vec(M), row-major")
        if levels is not None:
            product.array("source_level", levels.relative, "", "level of the source in each state over its mean")
            product.array("source_level_errors", levels.stderr, "", "standard errors of source_level")
        _store_noise(product, noise, solver)
        # HDF5 lets the interpreter go while it writes: one block is stored while the next is solved.
        with ThreadPoolExecutor(1) as storing:
            stored: Future[None] | None = None
            for rows in capture.row_blocks(BLOCK_PIXELS):
                if rows.stop > product.rows_done:
                    block = _block(solver, rows, planes, systematic, sent, levels)
                    if stored:
                        stored.result()
                    stored = storing.submit(product.write, rows, **block)
                if progress:
                    progress(rows.stop, capture.frame_shape[0])
            if stored:
                stored.result()
        try:
            facts = mueller_facts(inversion, noise, correction, product, len(states), choice.weighted)
        except CaptureError as error:
            product.discard()
            raise CaptureError(f"{capture.path}: {error}{_without_numbers(capture, states)}") from error
        facts["warnings"] += cut_off
        facts |= _further_facts(choice, sent) | references(capture, model)
        facts |= systematic.store(product) if systematic is not None else {}
        if levels is not None:
            facts["source"] = levels.told
        product.seal(facts)
    return facts


def _among(hits: NDArray[np.int64], every: NDArray[np.int64], states: NDArray[np.int64]) -> NDArray[np.int64]:
    """Hits (H, 4) with their state's number among `states` in place of that among `every`; of those that are there."""
    out = hits[np.isin(every[hits[:, 0]], states)]
    out[:, 0] = np.searchsorted(states, every[out[:, 0]])
    return out


def _further_facts(choice: Choice, sent: SentLight | None) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if sent is not None:
        found["determined"] = sent.named
    if choice.physical:
        found["physical_estimate"] = f"{choice.physical}, as mueller_physical beside the plain one"
    return found


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


def _systematic(
    capture: Capture,
    model: InstrumentModel,
    states: NDArray[np.int64],
    inversion: Inversion,
    source: LeveledSource,
) -> Systematic | None:
    def matrix(other: InstrumentModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        w = source.leveled(measurement_matrix(capture, other, states, capture_changes(capture, other, states)))[0]
        return w, w

    def counts(other: InstrumentModel) -> CountsCorrection | None:
        return counts_correction(capture_changes(capture, other, states), other)

    return Systematic.of(model, matrix, counts, inversion.basis)


def _block(
    solver: Solver,
    rows: slice,
    planes: Mapping[str, Plane],
    systematic: Systematic | None,
    sent: SentLight | None,
    levels: SourceLevels | None,
) -> dict[str, NDArray[Any]]:
    frames = solver.reader.read(rows)
    found = solver.solve(frames)
    if levels is not None:
        levels.add_errors(found, solver.inversion)
    mask = found["pixel_flags"]
    lost = (mask & np.uint8(Mask.NOT_FINITE | Mask.BAD | Mask.NOT_DETERMINED)) != 0
    if sent is not None:
        found |= sent.planes(found["mueller"], found["residual_rms"], solver)
        if systematic is not None:
            found["stokes_systematic"] = systematic.errors(found["mueller"], sent.rows)
            found["stokes_systematic"][~sent.seen] = np.nan
    elif systematic is not None:
        found["mueller_systematic"] = systematic.errors(found["mueller"])
    unseen = ~determined_elements(solver.inversion.basis)
    if unseen.any():
        for name in {"mueller", "mueller_errors", "mueller_systematic"} & set(found):
            found[name][unseen] = np.nan
        if "mueller_covariance" in found:
            found["mueller_covariance"][(unseen[:, None] | unseen)[np.tril_indices(ELEMENTS)]] = np.nan
    for name, values in found.items():
        if lost.any() and name != "pixel_flags":
            values[..., lost] = np.nan
    shape = (rows.stop - rows.start, solver.reader.capture.frame_shape[1])
    if "mueller_physical" in planes and "mueller_physical" not in found:
        found["mueller_physical"] = nearest(found["mueller"])
    return {name: found[name].reshape(*plane.leading, *shape) for name, plane in planes.items()}


def _without_numbers(capture: Capture, states: NDArray[np.int64]) -> str:
    """Which states have frames without a single number, as the end of a message."""
    empty = np.array([k for k in states if not np.isfinite(capture.frames(int(k))).any()], dtype=np.int64)
    if not empty.size:
        return ""
    return f" State(s) {_some(empty)} hold no number at all: take them again, or import without them."


def _some(values: NDArray[np.int64]) -> str:
    shown = ", ".join(str(v) for v in values[:5])
    return shown + (" ..." if len(values) > 5 else "")
