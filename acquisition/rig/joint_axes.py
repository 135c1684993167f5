"""The axes of a rig as one: they move at the same time, by ways that are allowed, and stop together."""

from collections.abc import Mapping, Sequence

from acquisition.cleanup import run_all
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.rig.way import Pose, find_homing_obstacle, find_obstacle, find_way, restricted_axes
from drivers.clock import Clock
from drivers.errors import LimitError, MotionFailed
from drivers.motion import Limits, Motion, MotionAxis, Position

#: Shortest pause between two looks at a moving axis.
SHORTEST_LOOK_S = 0.002
#: Longest wait for moves that were started and given up.
REST_WITHIN_S = 60.0


class JointAxes:
    """Named axes with the rules of a rig file for where they may go.

    Attributes
    ----------
    axes : dict of name to MotionAxis
    clock : of every wait and deadline.
    """

    def __init__(self, config: RigConfig, clock: Clock) -> None:
        self.config, self.clock = config, clock
        self.axes: dict[str, MotionAxis] = {}

    @property
    def time_scale(self) -> float:
        """Seconds of the devices for one second here."""
        return 1.0

    def homing_order(self) -> list[str]:
        """Names of all axes: those of the rig file's `home_order` first."""
        return [*self.config.home_order, *(name for name in self.axes if name not in self.config.home_order)]

    def unhomed(self) -> list[str]:
        """Names of the axes without a reference, in homing order."""
        return [name for name in self.homing_order() if not self.axes[name].is_homed()]

    def home(self, names: list[str]) -> None:
        """Home the axes one after another.

        Raises
        ------
        AcquisitionError
            One of them may meet a forbidden pose or bring solids together on its way; nothing was moved.
        MotionFailed
            Every axis has been sent a stop by then.
        """
        obstacle = find_homing_obstacle(self.config, names, self.known_pose())
        if obstacle is not None:
            raise AcquisitionError(f"{obstacle}. Nothing was moved.")
        for name in names:
            self.wait({name: self.axes[name].home()})

    def move(self, targets_deg: Mapping[str, float]) -> dict[str, Position]:
        """Move axes at the same time and wait; returns the positions read back at rest.

        An axis with backlash comes to its target from below, if its limits leave room for that.
        """
        below = {}
        for name, slack in self.config.backlash_deg.items():
            if name in targets_deg and targets_deg[name] < self.axes[name].read_position().deg - 1e-6:
                below[name] = targets_deg[name] - slack
        beyond = dict(targets_deg) | below
        if below and self._allowed(beyond):
            self.wait(self.start_moves(beyond))
        return self.wait(self.start_moves(targets_deg))

    def go(self, targets_deg: Pose, by: Sequence[Pose] = (), first: str | None = None) -> None:
        """Move to a pose by the way that `find_way` finds, if need be round what is forbidden.

        Raises AcquisitionError: there is no such way; nothing was moved.
        """
        way = find_way(self.config, self.known_pose(), targets_deg, by, limits=self.limits, first=first)
        if way is None:
            # It raises and names the obstacle.
            self._check_way(targets_deg)
        for targets in way or []:
            self.move(targets)

    def _allowed(self, targets_deg: Mapping[str, float]) -> bool:
        try:
            for name, target in targets_deg.items():
                self.axes[name].check(target)
            self._check_way(targets_deg)
        except (LimitError, AcquisitionError):
            return False
        return True

    def start_moves(self, targets_deg: Mapping[str, float]) -> dict[str, Motion]:
        """Start axes at the same time; those that stand within a count of their target are started too."""
        for name, target in targets_deg.items():
            self.axes[name].check(target)
        self._check_way(targets_deg)
        motions: dict[str, Motion] = {}
        try:
            for name, target in targets_deg.items():
                motions[name] = self.axes[name].start_move(target)
        except BaseException:
            self.stop()
            raise
        return motions

    def _check_way(self, targets_deg: Mapping[str, float]) -> None:
        obstacle = self._find_obstacle(targets_deg)
        if obstacle is not None:
            raise AcquisitionError(f"move to {dict(targets_deg)} meets {obstacle}. Nothing was moved.")

    def is_free(self, targets_deg: Mapping[str, float]) -> bool:
        """Whether the axes can move there straight away."""
        return self._find_obstacle(targets_deg) is None

    def _find_obstacle(self, targets_deg: Mapping[str, float]) -> str | None:
        if not restricted_axes(self.config) & targets_deg.keys():
            # Not even a position is read then: most moves are of rotators that nothing can hit.
            return None
        pose = self.known_pose()
        return find_obstacle(self.config, pose, pose | dict(targets_deg), targets_deg, limits=self.limits)

    @property
    def limits(self) -> dict[str, Limits]:
        """Limits of every axis, the tighter ones of controller and rig file."""
        return {name: axis.limits for name, axis in self.axes.items()}

    def known_pose(self) -> dict[str, float]:
        """Angles of the axes that forbidden poses and solids speak of, as far as they are known."""
        # The position of an axis without a reference is unknown, even if it gives a reading.
        axes = {name: self.axes[name] for name in restricted_axes(self.config) if name in self.axes}
        return {name: axis.read_position().deg for name, axis in axes.items() if axis.is_homed()}

    def pose_after_homing(self) -> dict[str, float]:
        """Angle of every axis after those without a reference have been homed, as far as the rig file tells.

        Where it does not, an axis is taken to end at its controller's zero.
        """
        ends = {name: path.ends_deg for name, path in self.config.homing.items()}
        return {
            name: axis.read_position().deg if axis.is_homed() else ends.get(name, axis.controller_zero_deg)
            for name, axis in self.axes.items()
        }

    def wait(self, motions: Mapping[str, Motion]) -> dict[str, Position]:
        """Wait for all motions and return the positions read back at rest.

        Raises MotionFailed: as the first axis that failed has it; every axis has been sent a stop.
        """
        pending = dict(motions)
        positions: dict[str, Position] = {}
        start_s = self.clock.now_s()
        try:
            while pending:
                for name, motion in list(pending.items()):
                    if motion.done():
                        positions[name] = motion.wait()
                        del pending[name]
                if pending:
                    self.clock.sleep_s(self._next_look_s(pending, self.clock.now_s() - start_s))
        except MotionFailed as failure:
            stop_error = self.stop()
            if stop_error is not None:
                failure.add_note(f"stopping the other axes failed too: {stop_error}")
            raise
        except BaseException:
            self.stop()
            raise
        return {name: positions[name] for name in motions}

    def rest(self) -> None:
        """Wait until no axis moves, after moves that were not waited for."""
        for axis in self.axes.values():
            end_s = self.clock.now_s() + REST_WITHIN_S
            while axis.is_moving():
                if self.clock.now_s() > end_s:
                    self.stop()
                    raise AcquisitionError(f"axis {axis.name} still moves after {REST_WITHIN_S:g} s; it was stopped")
                self.clock.sleep_s(axis.config.poll_s)

    def _next_look_s(self, motions: Mapping[str, Motion], elapsed_s: float) -> float:
        """Pause before the next look at moving axes: short around the time at which the last should arrive."""
        slowest = max(motions.values(), key=lambda motion: motion.expected_s)
        off_s = abs(slowest.expected_s / self.time_scale - elapsed_s)
        longest_s = min(self.axes[name].config.poll_s for name in motions)
        return min(max(off_s / 2, SHORTEST_LOOK_S), longest_s)

    def stop(self) -> Exception | None:
        """Stop every axis, also after a failure; returns the first failure."""
        return run_all([(f"stop axis {name}", axis.stop) for name, axis in self.axes.items()])
