"""Which camera answered through Aravis, over which link, and how its pixels are laid out."""

from typing import Any

from drivers import genicam
from drivers.aravis_config import Config
from drivers.aravis_setup import Setup
from drivers.camera import CameraIdentity
from drivers.genicam import Features
from drivers.pixel_formats import ANGLES_LAYOUT, PixelFormat


def identify(
    config: Config, aravis: Any, camera: Any, features: Features, *, setup: Setup, fmt: PixelFormat, bits: int
) -> CameraIdentity:
    """Read the identity of an open camera; raises CameraLost if it does not answer."""
    with features.asking("describe itself"):
        name, mtu = setup.interface or ("", None)
        address = camera.get_device().get_device_address().get_address().to_string() if setup.is_gige else ""
        return CameraIdentity(
            kind=config.kind,
            vendor=camera.get_vendor_name() or "",
            model=camera.get_model_name() or "",
            serial_number=features.text(genicam.SERIAL_NUMBER),
            firmware=features.text(genicam.FIRMWARE),
            address=address,
            interface=name,
            interface_mtu=mtu,
            packet_size=setup.packet_size(),
            packet_delay=_packet_delay(features) if setup.is_gige else None,
            resend=config.resend if setup.is_gige else None,
            sensor_width=int(features.number(genicam.SENSOR_WIDTH) or 0),
            sensor_height=int(features.number(genicam.SENSOR_HEIGHT) or 0),
            pixel_format=fmt.name,
            pixel_format_code=fmt.code,
            bits=bits,
            shift=config.shift,
            polarized=fmt.polarized,
            colours=fmt.colours,
            library=f"Aravis {aravis._version}",
            analyzers=ANGLES_LAYOUT if fmt.angles else None,
        )


def _packet_delay(features: Features) -> int | None:
    delay = features.number(genicam.PACKET_DELAY)
    return None if delay is None else int(delay)
