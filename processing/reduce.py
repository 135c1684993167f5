"""Reduce a capture to a Mueller image: black, flat, exposure, one inversion for all pixels, standard errors.

W is built from the angles read back. Row blocks keep memory constant; the product can be resumed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.capture import Capture, CaptureError
from processing.correction import BlockReader, Correction, Mask
from processing.instrument import InstrumentModel
from processing.inversion import Inversion
from processing.mueller_solver import MuellerSolver, solve_without_saturated
from processing.noise import NoiseModel
from processing.product import Plane, ProductWriter, Step

#: Called with (rows done, rows in all).
Progress = Callable[[int, int], None]

BLOCK_PIXELS = 1 << 18

#: Above this median, the model and not the noise makes the residual (the median of a good one is within 0.1 of 1).
SUSPICIOUS_CHI_SQUARE = 1.5

PLANES = {
    "mueller": Plane((4, 4), "count", "Mueller matrix, row-major, not normalized"),
    "mueller_errors": Plane((4, 4), "count", "standard errors of mueller"),
    "residual_rms": Plane((), "count", "root mean square over the states of intensity minus fit"),
    "pixel_mask": Plane((), "", f"0 = good; bits: {Mask.meaning()}", np.uint8),
}

CHI_SQUARE = Plane((), "", "squared residual over what the noise model expects; 1 if the model is complete")


def sample_states(capture: Capture) -> NDArray[np.int64]:
    """Positions of the states that look at the sample (or at air), dark and flat ones left out."""
    states = np.flatnonzero([r not in ("dark", "flat") for r in capture.role])
    if states.size == 0:
        raise CaptureError(f"{capture.path} has no state of the sample that is done; there is nothing to reduce.")
    return states


def measurement_matrix(capture: Capture, model: InstrumentModel, states: NDArray[np.int64]) -> NDArray[np.float64]:
    """W (states, channels, 16) from the read-back angles, rows scaled with the exposure (longest = 1)."""
    angles = {name: value[states] for name, value in capture.angles_deg.items()}
    missing = [axis for axis in model.axes if axis not in angles]
    if missing:
        have = ", ".join(sorted(angles)) or "none"
        raise CaptureError(
            f"{capture.path}: instrument {model.name!r} turns {', '.join(missing)}, but the capture has angles of: "
            f"{have}. Use the instrument file that belongs to the capture."
        )
    w = model.rows(angles)
    bad = ~np.all(np.isfinite(w.reshape(len(states), -1)), axis=1)
    if np.any(bad):
        raise CaptureError(
            f"{capture.path}: no read-back angle in state(s) {_some(states[bad])}; they cannot be reduced."
        )
    return w * relative_exposure(capture, states)[:, None, None]


def relative_exposure(capture: Capture, states: NDArray[np.int64]) -> NDArray[np.float64]:
    """Exposure of each state over the longest one; 1 where the capture does not know exposures."""
    exposure = capture.column("exposure_s")[states].astype(float)
    if not np.any(np.isfinite(exposure)):
        return np.ones(len(states))
    if not np.all(np.isfinite(exposure)) or np.any(exposure <= 0):
        raise CaptureError(
            f"{capture.path}: exposure_s is given for some states only, or not positive; give it for all or none."
        )
    return np.asarray(exposure / exposure.max())


def choose_model(capture: Capture, instrument: Path | None) -> InstrumentModel:
    """The instrument model at the capture's wavelength: from a file, else the one in the capture."""
    if instrument is not None:
        return InstrumentModel.load(instrument).at(capture.header.wavelength_nm)
    if capture.instrument is None:
        raise CaptureError(f"{capture.path} holds no instrument model. Give one with --instrument FILE.")
    return capture.instrument


def reduce_mueller(
    capture: Capture,
    model: InstrumentModel,
    out: Path,
    steps: tuple[Step, ...],
    correction: Correction | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the Mueller image of a capture; returns the facts that the product holds.

    Parameters
    ----------
    model : resolved at the capture's wavelength.
    correction : black, flat and masks; default: what the capture itself offers.

    Raises
    ------
    NotDetermined : W has a rank below 16.
    CaptureError : angles or frames are missing or not finite.
    """
    states = sample_states(capture)
    w = measurement_matrix(capture, model, states)
    inversion = Inversion.of(w.reshape(-1, 16), what=f"{capture.path}: ")
    correction = correction or Correction.of(capture)
    noise = NoiseModel.of(capture.header.detector, integer=capture.integer_counts)
    planes = PLANES if noise is None else PLANES | {"reduced_chi_square": CHI_SQUARE}
    solver = MuellerSolver(inversion, BlockReader(capture, states, correction), noise)
    with ProductWriter(out, "mueller", capture.header, capture.frame_shape, planes, steps, overwrite) as product:
        product.array("measurement_matrix", w, "", "W (state, channel, 16): intensity = W . vec(M), row-major")
        _store_noise(product, noise, solver)
        for rows in capture.row_blocks(BLOCK_PIXELS):
            if rows.stop > product.rows_done:
                product.write(rows, **_block(solver, rows, tuple(planes)))
            if progress:
                progress(rows.stop, capture.frame_shape[0])
        facts = _facts(inversion, noise, correction, product, len(states))
        product.seal(facts)
    return facts


def _store_noise(product: ProductWriter, noise: NoiseModel | None, solver: MuellerSolver) -> None:
    # variance of intensity n = slope[n] * signal + floor[n]; NaN: estimated from the residual.
    nothing = np.full(len(solver.repeats), np.nan)
    slope = noise.slope / solver.repeats if noise else nothing
    product.array("noise_slope", slope, "count", "shot noise: variance a signal count, for each row of W")
    floor = noise.averaged_floor(solver.repeats) if noise else nothing
    product.array("noise_floor", floor, "count2", "variance without light, for each row of W")


def _block(solver: MuellerSolver, rows: slice, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    frames = solver.reader.read(rows)
    found = solver.solve(frames)
    mask = found["pixel_mask"]
    repair = np.flatnonzero(mask & np.uint8(Mask.SATURATED))
    if repair.size:
        solve_without_saturated(solver, frames, repair, found)
    lost = (mask & np.uint8(Mask.NOT_FINITE | Mask.BAD | Mask.NOT_DETERMINED)) != 0
    for name, values in found.items():
        if lost.any() and name != "pixel_mask":
            values[..., lost] = np.nan
    shape = (rows.stop - rows.start, solver.reader.capture.frame_shape[1])
    return {name: found[name].reshape(*PLANES.get(name, CHI_SQUARE).leading, *shape) for name in names}


def _facts(
    inversion: Inversion,
    noise: NoiseModel | None,
    correction: Correction,
    product: ProductWriter,
    states: int,
) -> dict[str, Any]:
    mask, warnings = product.get("pixel_mask"), list(correction.warnings)
    good = (mask & ~np.uint8(Mask.SATURATED)) == 0
    counts = {flag.name.lower(): int(np.sum((mask & np.uint8(flag)) != 0)) for flag in Mask if flag.name}
    if not good.any():
        raise CaptureError(f"no pixel could be reduced: {in_words(counts)} of {mask.size} pixels. Nothing was written.")
    if any(counts.values()):
        warnings.append(f"of {mask.size} pixels: {in_words(counts)} (pixel_mask says where)")
    # Medians from about 128 rows are plenty, and read little.
    some = slice(None, None, max(1, mask.shape[0] // 128))
    residual, elements = product.get("residual_rms", some), product.get("mueller", some)
    signal = np.tensordot(inversion.w.mean(axis=0), elements.reshape(16, *residual.shape), axes=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = residual / signal
    facts: dict[str, Any] = {
        "states": states,
        "intensities_per_pixel": inversion.w.shape[0],
        "rank": 16,
        "condition_number": inversion.condition_number,
        "degrees_of_freedom": inversion.degrees_of_freedom,
        "black": correction.source,
        "noise": noise.source if noise else "estimated from each pixel's residual, because the gain is not known",
        "weighted": False,
        "median_residual_rms_count": _median(residual),
        "median_residual_over_signal": _median(relative),
        "pixels": mask.size,
        "masked": counts,
    }
    if noise is None and inversion.degrees_of_freedom == 0:
        warnings.append("as many unknowns as intensities and no gain: there are no standard errors")
    if noise is not None and inversion.degrees_of_freedom:
        ratio = _median(product.get("reduced_chi_square", some))
        facts["median_reduced_chi_square"] = ratio
        if ratio > SUSPICIOUS_CHI_SQUARE:
            warnings.append(
                f"the residual is {np.sqrt(ratio):.2g} times what the noise explains: the model lacks something. "
                "The standard errors do not contain it. Run `diagnose`."
            )
    return facts | {"warnings": warnings}


def _median(values: NDArray[Any]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def in_words(counts: dict[str, int]) -> str:
    """Numbers of masked pixels by reason, for a message."""
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n) or "none masked"


def _some(values: NDArray[np.int64]) -> str:
    shown = ", ".join(str(v) for v in values[:5])
    return shown + (" ..." if len(values) > 5 else "")
