"""One frame as things stand, for focusing and finding the sample."""

from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray

from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.rig.open_rig import open_rig
from drivers.camera import CameraSettings
from processing.doors import require_folder
from processing.yaml_file import ConfigError

#: Kinds of files: one to look at, and those that hold the counts.
PICTURE, COUNTS = ".png", (".tif", ".tiff", ".npy")


def take_frame(
    config: RigConfig, exposure_s: float, out: Path, light: bool, *, sample: str, wavelength_nm: float | None = None
) -> str:
    """Write one frame to `out` and describe it; light is on or off afterwards as it was found.

    A frame of a simulated rig says so in its name: `frame.tif` becomes `frame.simulated.tif`.

    Parameters
    ----------
    wavelength_nm : for a source that selects it, which keeps it; None leaves it as it is.

    Raises
    ------
    ProcessError
        Exposure, kind of file or folder that there is not.
    AcquisitionError, DeviceError
        The file cannot be written, or a device failed.
    """
    low, high = config.exposure_s
    if not low <= exposure_s <= high:
        raise ConfigError(f"--exposure {exposure_s:g}: the rig allows {low:g} to {high:g} s")
    if out.suffix.lower() not in (PICTURE, *COUNTS):
        raise ConfigError(f"{out}: a frame is written as .png (8 bits, stretched), .tif or .npy (counts)")
    require_folder(out)
    if config.simulated:
        out = out.with_name(f"{out.stem}.simulated{out.suffix}")
    with open_rig(config, ask=typer.confirm) as rig:
        rig.show(sample, wavelength_nm)
        before = rig.source.is_on() if rig.source is not None else None
        camera = rig.require_camera()
        # By software, also if captures use a hardware trigger: nothing fires one here.
        settings = camera.configure(CameraSettings(exposure_s=exposure_s, frame_average=1, trigger="software"))
        try:
            if rig.source is not None:
                if wavelength_nm is not None:
                    rig.source.select(wavelength_nm)
                rig.source.set_light(light)
            pixels = camera.capture(1)[0].pixels
        finally:
            if rig.source is not None and before is not None:
                rig.source.set_light(before)
        black = config.detector.black_level_counts
        full = camera.full_scale
    _write(out, pixels, black)
    saturated = 100 * float(np.count_nonzero(pixels >= full)) / pixels.size
    kind = "SIMULATED " if config.simulated else ""
    return (
        f"{kind}{out}: {pixels.shape[0]} x {pixels.shape[1]}, {settings.exposure_s or exposure_s:g} s, "
        f"mean {pixels.mean():.1f}, largest {pixels.max()} of {full} counts, {saturated:.3f} % saturated"
    )


def _write(out: Path, pixels: NDArray[np.uint16], black: float) -> None:
    if out.suffix.lower() == ".npy":
        np.save(out, pixels)
        return
    image: NDArray[np.uint16] | NDArray[np.uint8] = pixels
    if out.suffix.lower() == PICTURE:
        top = max(float(np.percentile(pixels, 99.8)), black + 1)
        image = np.clip((pixels.astype(np.float32) - black) / (top - black) * 255, 0, 255).astype(np.uint8)
    from PIL import Image

    try:
        Image.fromarray(image).save(out)
    except OSError as error:
        raise AcquisitionError(f"{out} cannot be written ({error.strerror or error}).") from error
