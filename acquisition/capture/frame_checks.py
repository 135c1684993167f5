"""Checks of each frame as it arrives: its own consistency, camera, lamp and shutter."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from acquisition.capture.repeated_state import RepeatedState
from acquisition.errors import RunFailed
from acquisition.rig.rig import Rig
from acquisition.screen.observer import StateReport
from drivers.camera import CameraSettings
from drivers.errors import FrameLost
from drivers.frame import Frame
from drivers.motion import Position
from processing.arrays import Array
from processing.reduction.frame_evidence import FrameEvidence
from processing.reduction.lit_darks import LitDarks

#: Settings that are read back with each frame, and by how much they may differ: of the exposure a part of it.
APPLIED = {"exposure_s": 0.002, "gain_db": 0.02, "black_level": 0.5, "reverse_x": 0.5, "reverse_y": 0.5}
#: A pixel below this part of full scale, above the black level, counts as near-black.
NEAR_BLACK = 0.01


class FrameChecks:
    """Compares each frame with what was asked for, with the darks, and with the other frames of the run.

    Parameters
    ----------
    black : counts without light, as declared.
    rows : of the measurement matrix (states, 16) for the mean of a frame; None where that is not known.
    lit_darks : comparison of darks and lights.
    warn : hears everything that does not end the run.
    before : the frame that the camera gave before the first one; None where it gave none.

    Attributes
    ----------
    evidence : findings so far.
    """

    def __init__(
        self,
        black: float,
        rows: Array | None,
        lit_darks: LitDarks,
        warn: Callable[[str], None],
        *,
        before: NDArray[np.generic] | None = None,
    ) -> None:
        self._black, self._warn, self._lit_darks = black, warn, lit_darks
        self._repeated = RepeatedState(black)
        self.evidence = FrameEvidence(black, rows, before)
        self._began_with: CameraSettings | None = None

    def require_as_reported(self, state: int, frame: Frame, settings: CameraSettings, rig: Rig) -> None:
        """Refuse a frame that came before, or that the camera took with other settings than it was set to.

        Raises FrameLost.
        """
        request = f"camera, frame of state {state}"
        repetition = self.evidence.repeats(frame.pixels)
        rig.last_frame = frame.pixels
        if repetition is not None:
            raise FrameLost(request, repetition, "Switch the camera off and on")
        applied = rig.require_camera().applied()
        # The exposure is that of the state; all else as at the first frame, not as another program left it meanwhile.
        self._began_with = self._began_with or settings
        was = self._began_with.model_copy(update={"exposure_s": settings.exposure_s})
        changed = [
            f"{name} {now:g} instead of {set_to:g}"
            for name, step in APPLIED.items()
            if (now := getattr(applied, name)) is not None
            and (set_to := getattr(was, name)) is not None
            and abs(now - set_to) > step * (set_to if name == "exposure_s" else 1.0)
        ]
        if changed:
            rig.forget_exposure()
            raise FrameLost(
                request, f"the camera has {', '.join(changed)}: something changed its settings", "End other programs"
            )

    def report(
        self, state: int, role: str, positions: dict[str, Position], exposure_s: float, *, frame: Frame, full_scale: int
    ) -> StateReport:
        """Statistics of a frame; `full_scale` is the largest count that a pixel can have."""
        pixels, dim = frame.pixels, self._black + NEAR_BLACK * (full_scale - self._black)
        return StateReport(
            state=state,
            role=role,
            positions=positions,
            exposure_s=exposure_s,
            saturated_fraction=float(np.count_nonzero(pixels >= full_scale)) / pixels.size,
            near_black_fraction=float(np.count_nonzero(pixels < dim)) / pixels.size,
            monitor=(float(pixels.mean()) - self._black) / exposure_s,
            pixels=pixels,
        )

    def look(self, report: StateReport, frame: Frame, planned_s: float, pose: tuple[float, ...]) -> None:
        """Compare an accepted frame with the others.

        Parameters
        ----------
        planned_s, pose : exposure and angles of the state in the plan.

        Raises
        ------
        RunFailed
            The darks hold light.
        """
        self._look_for_light(report, planned_s, pose)
        findings = self.evidence.look(
            report.state,
            frame.pixels,
            number=frame.frame_id,
            camera_ns=frame.camera_time_ns,
            exposure_s=report.exposure_s,
            light=report.role not in ("dark", "flat"),
        )
        for finding in findings:
            self._warn(f"false frame: {finding.text}")

    def _look_for_light(self, report: StateReport, planned_s: float, pose: tuple[float, ...]) -> None:
        if report.role == "dark":
            self._lit_darks.dark(planned_s, pose, report.pixels)
            return
        changed = self._repeated.look(report.state, planned_s, pose, report.pixels)
        if changed is not None:
            self._warn(changed)
        problem = self._lit_darks.light(planned_s, pose, report.pixels)
        if problem is not None:
            raise RunFailed(
                f"state {report.state}: {problem}. The light was not shut off for them, or the black level is wrong. "
                "Make sure that the source darkens the sample, or correct detector.black_level_counts in the rig file, "
                "and begin the capture again."
            )
        unlit = self._lit_darks.without_light(planned_s)
        if unlit is not None:
            self._warn(
                f"{unlit}: is the source on at this wavelength, its shutter open, the lens free? The capture continues"
            )

    def judge(self) -> None:
        """Report evidence against the camera from all frames of the run."""
        for finding in self.evidence.judge():
            self._warn(f"false frame: {finding.text}")
