"""Axes whose controller cannot tell whether it is homed: the session remembers, and watches the resting position."""

from pydantic import Field

from drivers.clock import REAL, Clock
from drivers.motion import AxisConfig, MotionAxis


class SessionReferenceConfig(AxisConfig):
    """Rig entries of an axis that cannot say whether it is homed."""

    assume_homed: bool = Field(
        default=False,
        description="the operator states that the axis was homed since it was switched on; the device cannot tell",
    )


class SessionReferenceAxis(MotionAxis):
    """Homed after `home()` in this session, or because the rig file says so.

    The reference is given up when the resting axis shows another position than the one it was left at: the
    controller was reset, or it was turned by hand.
    """

    def __init__(self, name: str, config: SessionReferenceConfig, clock: Clock = REAL) -> None:
        super().__init__(name, config, clock)
        self._referenced = config.assume_homed
        self._homing = False
        # Set by the driver when the device was seen in motion or told of its end.
        self._saw_motion = False
        self._rest_counts: float | None = None
        self._loss = ""

    def _begin_homing(self) -> None:
        self._saw_motion = False
        self._homing, self._referenced, self._loss = True, False, ""
        self._rest_counts = None

    def _begin_moving(self) -> None:
        self._homing = False
        self._rest_counts = None

    def _do_note_rest(self, counts: float) -> None:
        self._rest_counts = counts

    def _do_is_homed(self) -> bool:
        if self._do_is_moving():
            return self._referenced
        counts, confirmed = self._read_confirmed()
        if not confirmed:
            return self._referenced
        tolerance = self.config.tolerance_deg * abs(self.counts_per_deg)
        if self._homing:
            self._do_check_fault()
            # A command that never arrived leaves an idle axis too: something must have been seen to happen.
            self._homing, self._referenced = False, self._homing_is_proved(counts, tolerance)
        if self._rest_counts is not None and abs(counts - self._rest_counts) > tolerance and self._referenced:
            self._referenced = False
            self._loss = f"the resting position jumped from {self._rest_counts:g} to {counts:g} counts: home again"
        self._rest_counts = counts
        return self._referenced

    def _homing_is_proved(self, counts: float, tolerance: float) -> bool:
        return self._saw_motion

    def _give_up_homing(self) -> None:
        """Homing was stopped or failed: it makes no reference."""
        self._homing = False

    def _reference_warnings(self) -> list[str]:
        if self._loss:
            return [self._loss]
        if self._referenced:
            return []
        return ["not homed in this session, and the device cannot tell whether it ever was"]
