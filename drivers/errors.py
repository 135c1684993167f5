"""Errors of devices: each has the request, the answer and the advice."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


class DeviceError(Exception):
    """A device did not do what it was asked.

    Parameters
    ----------
    asked : str
        The request, with the name of the device.
    came_back : str
        Answer of the device or the operating system.
    what_to_do : str
        The next step for the person at the bench.
    """

    def __init__(self, asked: str, came_back: str, what_to_do: str) -> None:
        super().__init__(asked, came_back, what_to_do)
        self.asked = asked
        self.came_back = came_back
        self.what_to_do = what_to_do

    def __str__(self) -> str:
        return f"{self.asked}: {self.came_back}. {self.what_to_do}"


class PortNotFound(DeviceError):
    """The port does not exist or cannot be opened as a serial line."""


class PortLost(DeviceError):
    """The port was open and vanished: cable pulled, power off, connection closed."""


class PortBusy(DeviceError):
    """Another program holds the port; the message names it where the system does."""


class PermissionRefused(DeviceError):
    """This user may not open the port; the owning group is named."""


class ReplyError(DeviceError):
    """What came back is garbled or belongs to another request or device."""


class ReplyTimeout(DeviceError):
    """Nothing came back in time."""


class CommandRejected(DeviceError):
    """The controller understood the command and refused it."""


class LimitError(DeviceError):
    """The target lies outside the limits of the axis; nothing was sent."""


class NotHomedError(DeviceError):
    """The axis has no reference position, so its angles mean nothing yet."""


class WrongDevice(DeviceError):
    """The device found is not the one that the rig file names."""


class MotionFailed(DeviceError):
    """A motion did not end at its target in the time that distance and speed allow.

    Parameters
    ----------
    axis : name of the axis.
    target_deg : target in user degrees, None for homing.
    last_deg : last position that was read, in user degrees; None if none could be read.
    elapsed_s, allowed_s : time since the start of the motion and the time it was given.
    why : observation: stalled, silent, fault flag, wrong end position.
    unit : of target and position; "V" for a liquid crystal.
    """

    def __init__(
        self,
        axis: str,
        target_deg: float | None,
        last_deg: float | None,
        elapsed_s: float,
        *,
        allowed_s: float,
        why: str,
        what_to_do: str = "The axis was sent a stop. Look at the axis before you move it again",
        unit: str = "deg",
    ) -> None:
        request = f"axis {axis}, " + ("home" if target_deg is None else f"move to {target_deg:.4f} {unit}")
        last = "not known" if last_deg is None else f"{last_deg:.4f} {unit}"
        came_back = f"{why}; last position {last}, after {elapsed_s:.2f} s of {allowed_s:.2f} s allowed"
        super().__init__(request, came_back, what_to_do)
        self.axis = axis
        self.target_deg = target_deg
        self.last_deg = last_deg
        self.elapsed_s = elapsed_s
        self.allowed_s = allowed_s
        self.why = why
        self.unit = unit

    def __reduce__(self) -> tuple[object, ...]:
        # Exception pickles by its args, which here are the three parts of the message.
        more: dict[str, Any] = {name: getattr(self, name) for name in ("allowed_s", "why", "what_to_do", "unit")}
        return partial(type(self), self.axis, self.target_deg, self.last_deg, self.elapsed_s, **more), ()


class MotionStopped(MotionFailed):
    """A motion was ended by `stop()` before it reached its target."""


class CameraError(DeviceError):
    """A camera did not do what it was asked."""


class CameraNotFound(CameraError):
    """The camera that the rig file names did not answer; what did answer is listed."""


class CameraBusy(CameraError):
    """Another program controls the camera."""


class CameraLost(CameraError):
    """The camera stopped answering, or control over it was lost."""


@contextmanager
def ignore_refusals() -> Iterator[None]:
    """Go on after the block where the camera refuses something in it; a lost camera is raised."""
    try:
        yield
    except CameraLost:
        raise
    except CameraError:
        pass


class FrameLost(CameraError):
    """A frame did not arrive whole. Nothing of it was kept; the exposure has to be repeated."""


class SettingRefused(CameraError):
    """A setting is outside the camera's limits, is missing there, or was read back as something else."""


class UnknownPixelFormat(CameraError):
    """The layout of the pixels in memory is not known, so they would be guessed."""
