"""Analysis vectors of single pixels of a polarization sensor (Powell and Gruev, Opt. Express 21, 21039, 2013).

No two micro-polarizers are alike: azimuth, extinction and gain differ by some per cent. Each pixel's response to a
linear Stokes vector, I = a . S, is measured with known polarization; a frame is then corrected to what ideal
pixels would have seen.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import NotDetermined, ProcessError
from processing.instrument.model import InstrumentModel
from processing.reduction.counts_to_signal import BlockReader, CountCorrection
from processing.reduction.measurement_matrix import relative_exposure
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.sample_states import sample_states
from processing.reduction.solvers.inversion import multiply_tiles
from processing.storage.captures.capture import Capture
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane, Step
from processing.storage.products.product_writer import ProductWriter

LINEAR = 3

PLANES = {
    "response": Plane((LINEAR,), "", "analysis vector of each raw pixel: counts = response . (S0, S1, S2), scaled"),
    "residual_rms": Plane((), "", "rms of counts minus fit over the mean counts"),
}


def fit_response(
    capture: Capture, model: InstrumentModel, out: Path, step: Step, *, overwrite: bool = False
) -> dict[str, Any]:
    """Fit the response of each raw pixel to light of known polarization; write a product "analyzers".

    The capture holds mosaic frames of an even field behind a polarizer that the instrument's generator turns; the
    sample is air. Uneven light cannot be told from uneven gain and goes into the response. Raises NotDetermined: the
    generator's states do not span linear polarization.
    """
    mosaic = capture.header.mosaic or model.mosaic
    if mosaic is None:
        raise ProcessError(f"{capture.path} is not a mosaic capture; there are no pixel analyzers to calibrate.")
    if capture.header.sample.kind != "air":
        raise ProcessError(
            f"{capture.path}: polarization at the sensor is known only with nothing before it (sample air)."
        )
    states = sample_states(capture)
    light = model.generator_states({k: v[states] for k, v in capture.angles_deg.items()})[:, :LINEAR]
    light = light * relative_exposure(capture, states)[:, None]
    rank = int(np.linalg.matrix_rank(light, rtol=1e-3))
    if rank < LINEAR:
        raise NotDetermined(
            f"{capture.path}: {len(states)} states of the generator have rank {rank} in "
            "(S0, S1, S2), and 3 are needed. Turn the polarizer to at least three different angles."
        )
    reader = BlockReader(capture, states, CountCorrection.of(capture))
    inverse = np.linalg.pinv(light).astype(np.float32)
    rows, columns = capture.frame_shape
    response = np.empty((LINEAR, rows, columns), np.float32)
    residual = np.empty((rows, columns), np.float32)
    saturated = 0
    for block in capture.row_blocks():
        frames = reader.read(block)
        corrected = np.empty(frames.shape, np.float32)
        mask = np.zeros(frames.shape[2], np.uint8)
        reader.load(frames, 0, frames.shape[2], corrected, mask=mask)
        saturated += int(np.count_nonzero(mask & np.uint8(Mask.SATURATED)))
        signal: NDArray[np.float32] = corrected[:, 0, :]
        part = np.empty((LINEAR, frames.shape[2]), np.float32)
        multiply_tiles(inverse, signal, part)
        misfit = signal - light.astype(np.float32) @ part
        with np.errstate(divide="ignore", invalid="ignore"):
            rms = np.sqrt(np.mean(misfit**2, axis=0)) / np.mean(signal, axis=0)
        response[:, block] = part.reshape(LINEAR, -1, columns)
        residual[block] = rms.reshape(-1, columns)
    response /= 2 * np.nanmean(response[0])
    layout = MosaicLayout.of(mosaic, [c.name for c in model.channels])
    facts = _facts(response, residual, layout, len(states))
    if saturated:
        facts["warnings"].append(
            f"{saturated} of {rows * columns} pixels saturate in some state, and their response is wrong: expose less"
        )
    with ProductWriter(
        out, "analyzers", capture.header, (rows, columns), planes=PLANES, steps=(step,), overwrite=overwrite
    ) as writer:
        writer.write(slice(0, rows), response=response, residual_rms=residual)
        writer.seal(facts)
    return facts


def _facts(
    response: NDArray[np.float32], residual: NDArray[np.float32], layout: MosaicLayout, states: int
) -> dict[str, Any]:
    facts: dict[str, Any] = {"states": states, "median_residual_over_signal": float(np.nanmedian(residual))}
    for k, name in enumerate(layout.channels):
        a = np.stack([layout.samples(plane, k) for plane in response])
        azimuth = np.rad2deg(0.5 * np.angle(np.nanmean(a[1] + 1j * a[2]))) % 180
        contrast = np.hypot(a[1], a[2]) / a[0]
        facts[f"azimuth_deg_{name}"] = float(azimuth)
        facts[f"diattenuation_{name}"] = float(np.nanmedian(contrast))
        facts[f"gain_spread_{name}"] = float(np.nanstd(a[0]) / np.nanmean(a[0]))
    return facts | {"warnings": []}
