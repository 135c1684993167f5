"""Report of a reduction: numbers for the summary, and warnings that need an action."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.instrument.determined_basis import determined_elements
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.inversion import Inversion
from processing.storage.captures.capture import CaptureError
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import is_lit
from processing.storage.products.product_writer import ProductWriter

#: Above this median, the model and not the noise makes the residual (the median of a good one is within 0.1 of 1).
SUSPICIOUS_CHI_SQUARE = 1.5
#: Below this the noise is overstated.
TOO_SMALL_CHI_SQUARE = 0.5
#: Medians are taken from about so many rows or pixels, whichever is less: they are plenty, and little is read.
SOME_ROWS, SOME_PIXELS = 128, 1 << 17


def mueller_facts(
    inversion: Inversion,
    noise: NoiseModel | None,
    correction: CountCorrection,
    product: ProductWriter,
    *,
    states: int,
    weighted: bool,
) -> dict[str, Any]:
    """Facts of a Mueller image that is written but not sealed yet.

    Raises CaptureError: not one pixel could be reduced.
    """
    mask, warnings = product.get("pixel_flags"), list(correction.warnings)
    good = (mask & ~np.uint8(Mask.PARTLY)) == 0
    counts = {flag.name.lower(): int(np.sum((mask & np.uint8(flag)) != 0)) for flag in Mask if flag.name}
    if not good.any():
        raise CaptureError(f"no pixel could be reduced: {in_words(counts)} of {mask.size} pixels. Nothing was written.")
    if any(counts.values()):
        warnings.append(f"of {mask.size} pixels: {in_words(counts)} (pixel_flags says where)")
    some = slice(None, None, max(1, mask.shape[0] // SOME_ROWS, mask.size // SOME_PIXELS))
    residual, elements = product.get("residual_rms", some), product.get("mueller", some)
    signal = np.tensordot(inversion.w.mean(axis=0), np.nan_to_num(elements.reshape(16, *residual.shape)), axes=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = residual / signal
        errors, m00 = product.get("mueller_errors", some), elements[0, 0]
        lit = is_lit(m00, errors[0, 0])
        each = (errors.reshape(16, *m00.shape)[1:] / m00)[:, lit]
    facts: dict[str, Any] = {
        "states": states,
        "intensities_per_pixel": inversion.w.shape[0],
        "rank": inversion.rank,
        "condition_number": inversion.condition_number,
        "degrees_of_freedom": inversion.degrees_of_freedom,
        "black": correction.source,
        "flat": correction.flat.source if correction.flat else "none",
        "noise": noise.source if noise else "not known: no gain, and no residual is left over",
        "weighted": weighted,
        "median_residual_rms_count": _median(residual),
        "median_residual_over_signal": _median(relative),
        "median_standard_error_of_mij_over_m00": _median(each),
        "pixels": mask.size,
        "masked": counts,
    }
    if correction.flat and noise:
        # One factor for all elements of a pixel; normalized quantities do not have it.
        facts["flat_error_percent"] = 100 * float(np.sqrt(np.median(correction.flat.relative_variance(noise))))
    if noise is None and inversion.degrees_of_freedom == 0:
        warnings.append("as many unknowns as intensities and no gain: there are no standard errors")
    if noise is not None and noise.residual_share is None and inversion.degrees_of_freedom:
        ratio = _median(product.get("reduced_chi_square", some))
        facts["median_reduced_chi_square"] = ratio
        if ratio > SUSPICIOUS_CHI_SQUARE:
            warnings.append(
                f"the residual is {np.sqrt(ratio):.2g} times what the noise explains: the model lacks something. "
                "The standard errors do not contain it. Run `diagnose`."
            )
        elif ratio < TOO_SMALL_CHI_SQUARE:
            warnings.append(
                f"the residual is only {np.sqrt(ratio):.2g} of what the noise explains, so the standard errors are too "
                "large: the gain or read noise is not this camera's, or a black level was not subtracted"
            )
    if inversion.rank < len(inversion.basis):
        facts["determined"] = determined_words(inversion)
    return facts | {"warnings": warnings}


def determined_words(inversion: Inversion) -> str:
    """Which elements a partial polarimeter determines, as `seen_elements` reads it."""
    is_determined = determined_elements(inversion.basis)
    return ", ".join(f"m{k // 4}{k % 4}" for k in np.flatnonzero(is_determined)) or "combinations only"


def _median(values: NDArray[Any]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def in_words(counts: dict[str, int]) -> str:
    """Numbers of masked pixels by reason, for a message."""
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n) or "none masked"
