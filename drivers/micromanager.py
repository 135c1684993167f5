"""The Micro-Manager core of this process, as pymmcore-plus holds it: one core for all users.

A program that has a core already (a notebook, a viewer) shares it with the drivers; for a command of its own, such as
`acquire`, the rig file names the configuration that is loaded first. What goes wrong in a device is an exception, whose
type is its adapter's own.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drivers.errors import CommandRejected, DeviceError

NOT_TOLD = "not told by the core"


def running_core(request: str, configuration: Path | None, device: str) -> Any:
    """Return the core of this process; loads the configuration if it has no device of that name yet.

    Raises DeviceError: pymmcore-plus is not installed, or the configuration cannot be loaded.
    """
    try:
        from pymmcore_plus import CMMCorePlus
    except ImportError as error:
        raise DeviceError(request, "pymmcore-plus is not installed", "Install it: pip install pymmcore-plus") from error
    core: Any = CMMCorePlus.instance()
    if configuration is not None and device not in core.getLoadedDevices():
        with asking(f"{request}, load {configuration}", "Try the file in Micro-Manager"):
            core.loadSystemConfiguration(str(configuration))
    return core


def loaded_devices(core: Any) -> str:
    """The devices that the core holds, in words."""
    return ", ".join(label for label in core.getLoadedDevices() if label != "Core") or "no device"


@contextmanager
def asking(
    request: str, what_to_do: str = "Look at the device in Micro-Manager", kind: type[DeviceError] = CommandRejected
) -> Iterator[None]:
    """Turn an error of the core or of an adapter inside the block into one of the given kind."""
    try:
        yield
    except DeviceError:
        raise
    except Exception as error:
        raise kind(request, str(error) or type(error).__name__, what_to_do) from error
