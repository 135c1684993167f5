"""Getting at Aravis: the late import, which cameras answer, and the network interface a camera is reached by."""

import contextlib
import fcntl
import ipaddress
import socket
import struct
import warnings
from typing import Any

from drivers.clock import REAL
from drivers.errors import CameraBusy, CameraError, CameraNotFound

_SIOCGIFADDR = 0x8915
_SIOCGIFMTU = 0x8921
# GigE Vision bootstrap register: address of the application that controls the camera (optional for cameras).
_PRIMARY_APPLICATION_IP = 0x0A14
# A camera frees itself when it has heard nothing for its heartbeat's time: 3 s, unless a program sets another.
_FREES_ITSELF_S = 5.0


def load_aravis() -> tuple[Any, Any]:
    """Import Aravis and return its module and GLib's exception class.

    Raises CameraError: `gi` or the Aravis typelib is not installed.
    """
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        with warnings.catch_warnings():
            # Debian 12's PyGObject imports in a way that Python 3.11 calls outdated.
            warnings.simplefilter("ignore", ImportWarning)
            from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise CameraError(
            "import Aravis",
            str(error),
            "Install Debian's python3-gi and gir1.2-aravis-0.8 (apt install). Then run ./lab again, which exposes gi "
            "to its Python; with pip, make the environment by `python3 -m venv --system-site-packages ENVIRONMENT`",
        ) from error
    return Aravis, GLib.Error


def list_cameras(aravis: Any) -> list[dict[str, str]]:
    """Ask which cameras are there; takes about one second.

    Returns
    -------
    list of dict
        Keys `id`, `vendor`, `model`, `serial_number` and `address` of each camera that answered.
    """
    aravis.update_device_list()
    return [
        {
            "id": aravis.get_device_id(i) or "",
            "vendor": aravis.get_device_vendor(i) or "",
            "model": aravis.get_device_model(i) or "",
            "serial_number": aravis.get_device_serial_nbr(i) or "",
            "address": aravis.get_device_address(i) or "",
        }
        for i in range(aravis.get_n_devices())
    ]


def open_camera(name: str, device: str | None, aravis: Any, glib_error: Any) -> Any:
    """Open a camera by id, serial number or IP address and take control of it.

    A camera whose program was killed is waited for, until it frees itself.

    Parameters
    ----------
    name : name of the camera in messages.
    device : None takes the only camera there is.

    Returns
    -------
    Aravis.Camera

    Raises
    ------
    CameraNotFound
        Nothing answers to that name, or None was given and there is not exactly one; what was found is listed.
    CameraBusy
        Another program controls it.
    """
    key = device if device is not None and _is_address(device) else _find(name, device, aravis)
    try:
        camera = aravis.Camera.new(key)
    except glib_error as error:
        raise _not_found(name, device, list_cameras(aravis), str(error.message)) from error
    link = camera.get_device()
    if isinstance(link, aravis.GvDevice) and not _control(link, glib_error):
        raise CameraBusy(
            f"open camera {name!r}, device {key}",
            f"{_holder(link, glib_error)} controls it already",
            f"It was asked for {_FREES_ITSELF_S:.0f} s, in which a camera frees itself after a crash. "
            "Close the other program",
        )
    return camera


def _find(name: str, device: str | None, aravis: Any) -> str:
    cameras = list_cameras(aravis)
    matches = [c for c in cameras if device is None or device in (c["id"], c["serial_number"], c["address"])]
    if len(matches) != 1:
        raise _not_found(name, device, cameras, "")
    return matches[0]["id"]


def _not_found(name: str, device: str | None, cameras: list[dict[str, str]], detail: str) -> CameraNotFound:
    listing = ", ".join(f"{c['id']} (serial {c['serial_number']}, at {c['address']})" for c in cameras) or "no camera"
    return CameraNotFound(
        f"open camera {name!r}" + (f", device {device}" if device else ""),
        f"found {listing}" + (f"; {detail}" if detail else ""),
        "Check power and cable, and that the interface is in the camera's subnet"
        if not cameras
        else "Set `device` in the rig file to one of those",
    )


def _control(link: Any, glib_error: Any) -> bool:
    """Take control, at once or when the camera has lost its previous controller."""
    until_s = REAL.now_s() + _FREES_ITSELF_S
    while not link.is_controller() and REAL.now_s() < until_s:
        with contextlib.suppress(glib_error):
            link.take_control()
        REAL.sleep_s(0.1)
    return bool(link.is_controller())


def _holder(link: Any, glib_error: Any) -> str:
    try:
        number = int(link.read_register(_PRIMARY_APPLICATION_IP))
    except glib_error:
        number = 0
    return f"a program at {ipaddress.IPv4Address(number)}" if number else "another program"


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def interface_of(address: str) -> tuple[str, int] | None:
    """Name and MTU in bytes of the network interface that has an IPv4 address; None if none has it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:15])
            try:
                reply = fcntl.ioctl(probe, _SIOCGIFADDR, request)
            except OSError:
                continue
            if socket.inet_ntoa(reply[20:24]) == address:
                return name, int(struct.unpack_from("i", fcntl.ioctl(probe, _SIOCGIFMTU, request), 16)[0])
    return None
