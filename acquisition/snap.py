"""One frame as things stand, for focusing and finding the sample."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from acquisition.errors import AcquisitionError
from acquisition.rig import Rig
from acquisition.rig_config import RigConfig
from processing.instrument import InstrumentModel


def take_frame(config: RigConfig, exposure_s: float, out: Path, light: bool, sample: str) -> str:
    """Write one frame to `out` and describe it; the light is put back as it was found.

    Raises
    ------
    AcquisitionError, DeviceError
        The file cannot be written, or a device failed.
    """
    with Rig(config) as rig:
        if rig.simulation is not None:
            model = InstrumentModel.load(next(iter(config.modes.values())).instrument)
            rig.simulation.prepare(sample, model, config.wavelengths_nm[0])
        before = rig.source.is_on() if rig.source is not None else None
        settings = rig.set_exposure(exposure_s, 1)
        camera = rig.require_camera()
        try:
            if rig.source is not None:
                rig.source.set_light(light)
            pixels = camera.capture(1)[0].pixels
        finally:
            if rig.source is not None and before is not None:
                rig.source.set_light(before)
        black = config.detector.black_level_counts
        full = camera.full_scale
    shown = pixels
    if out.suffix.lower() == ".png":
        top = max(float(np.percentile(pixels, 99.8)), black + 1)
        shown = np.clip((pixels.astype(np.float32) - black) / (top - black) * 255, 0, 255).astype(np.uint8)
    elif out.suffix.lower() not in (".tif", ".tiff"):
        raise AcquisitionError(f"{out}: a frame is written as .png (8 bits, stretched) or .tif (counts)")
    if not cv2.imwrite(str(out), shown):
        raise AcquisitionError(f"{out} cannot be written")
    saturated = 100 * float(np.count_nonzero(pixels >= full)) / pixels.size
    kind = "SIMULATED " if config.simulated else ""
    return (
        f"{kind}{out}: {pixels.shape[0]} x {pixels.shape[1]}, {settings.exposure_s or exposure_s:g} s, "
        f"mean {pixels.mean():.1f}, largest {pixels.max()} of {full} counts, {saturated:.3f} % saturated"
    )
