"""What `simulate serve` and the tests can choose for an emulated controller."""

from collections.abc import Callable
from dataclasses import dataclass, field

from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis
from simulators.serial.reply_faults import FaultSchedule


@dataclass
class ServeOptions:
    """Choices for an emulator; None means the default of its kind.

    Attributes
    ----------
    model : model that it says it is.
    axes : number of devices, modules or channels.
    limits_deg : travel of every axis in degrees.
    speed_deg_s, acceleration_deg_s2 : a full turn takes 1.4 s with the defaults.
    homed : start with a reference, at angle zero.
    true_angle : hidden error: turns the mechanical into the true angle (degrees).
    """

    model: str | None = None
    axes: int | None = None
    limits_deg: tuple[float | None, float | None] | None = None
    speed_deg_s: float = 300.0
    acceleration_deg_s2: float = 1500.0
    homed: bool = False
    true_angle: Callable[[float], float] | None = None
    clock: FastClock = field(default_factory=FastClock)
    faults: FaultSchedule = field(default_factory=FaultSchedule)

    def axis(self, low_deg: float | None, high_deg: float | None, start_deg: float) -> EmulatedAxis:
        """Make one axis with these choices."""
        return EmulatedAxis(
            self.clock,
            self.speed_deg_s,
            self.acceleration_deg_s2,
            min_deg=low_deg,
            max_deg=high_deg,
            homed=self.homed,
            start_deg=0.0 if self.homed else start_deg,
            true_angle=self.true_angle,
        )
