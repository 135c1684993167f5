"""Trigger and exposure status of a camera: ready for a trigger, exposing.

A trigger that comes before the camera is armed is ignored (Lucid's `TriggerArmed`; SFNC and Basler: `AcquisitionStatus`
of `FrameTriggerWait`).
"""

from drivers.genicam import Features

_ARMED = "TriggerArmed"
_SELECTOR, _STATUS = "AcquisitionStatusSelector", "AcquisitionStatus"
_WAITING, _EXPOSING = "FrameTriggerWait", "ExposureActive"


class AcquisitionStatus:
    """The status features of one camera, found when its trigger was set up; None for a camera not set up yet.

    Attributes
    ----------
    tells_exposing : True if the camera tells when an exposure has ended.
    tells_armed : True if it tells when it would heed a trigger.
    """

    def __init__(self, features: Features | None) -> None:
        self._features = features
        self._selected = ""
        statuses: list[str] = []
        self._has_armed = False
        if features is not None:
            statuses = features.choices(_SELECTOR) if features.find((_STATUS,)) is not None else []
            self._has_armed = features.find((_ARMED,)) is not None
        self.tells_exposing = _EXPOSING in statuses
        self.tells_armed = self._has_armed or _WAITING in statuses

    def exposing(self) -> bool:
        """True while light is collected; False where the camera does not tell."""
        return self.tells_exposing and self._status(_EXPOSING)

    def armed(self) -> bool:
        """True when a trigger would be heeded now, and where the camera does not tell."""
        if self._has_armed and self._features is not None:
            return self._features.flag(_ARMED)
        return not self.tells_armed or self._status(_WAITING)

    def _status(self, status: str) -> bool:
        if self._features is None:
            return False
        if self._selected != status:
            self._features.set_choice(_SELECTOR, status)
            self._selected = status
        return self._features.flag(_STATUS)
