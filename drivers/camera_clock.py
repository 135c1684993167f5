"""The time at which a frame left its camera, by the camera's own clock.

The host notes a frame when it gets round to reading it, which on a busy machine may be much later. The camera notes
it as it exposes. So a frame of an exposure that nobody asked for can look as if it came after the next trigger,
until the two clocks are compared: the fastest delivery seen so far tells how far they are apart, and no frame can have
been slower on its way than the host saw, nor faster than that.
"""

import logging

log = logging.getLogger(__name__)

# Two crystals, one of them steered by a time server, part by less than this.
_DRIFT = 5e-4
# No frame is waited for that long, so clocks that disagree by more do not count the same seconds.
_DISAGREE_S = 3.0


class CameraClock:
    """The host time at which frames came, freed from the host's own delays.

    The camera may stamp a frame at the start or at the end of its exposure; nothing here depends on which.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._first: tuple[int, float] | None = None
        self._trusted = True
        # Camera time minus host time at least, in seconds from the first frame; of the host time and exposure given.
        self._ahead_s: float | None = None
        self._at_s = 0.0
        self._exposure_s = 0.0

    def forget(self) -> None:
        """Start again, after the stream was interrupted."""
        self._ahead_s = None

    def forget_all(self) -> None:
        """Begin anew after the host's clock was set: nothing that was compared before holds any more."""
        self._first, self._ahead_s, self._trusted = None, None, True

    def came_s(self, camera_time_ns: int, first_packet_s: float, exposure_s: float) -> float:
        """Unix time at which the first packet would have been seen by a host that is never late.

        Parameters
        ----------
        camera_time_ns : the camera's stamp of the frame, from any zero; 0 if it has none.
        first_packet_s : Unix time at which the host saw the first packet.
        exposure_s : exposure time of the frame.

        Returns
        -------
        float
            At most `first_packet_s`; equal to it while there is nothing to compare with, or if the clocks do not agree.
        """
        if camera_time_ns <= 0 or first_packet_s <= 0 or not self._trusted:
            return first_packet_s
        if self._first is None:
            self._first = (camera_time_ns, first_packet_s)
        camera_s = (camera_time_ns - self._first[0]) * 1e-9
        host_s = first_packet_s - self._first[1]
        if abs(camera_s - host_s) > _DISAGREE_S + _DRIFT * abs(host_s) + exposure_s:
            log.warning(
                "camera %s: its clock ran %.3f s while the host's ran %.3f s; it no longer helps to tell stale frames",
                self._name,
                camera_s,
                host_s,
            )
            self._trusted = False
            return first_packet_s
        ahead_s = camera_s - host_s
        if self._ahead_s is not None:
            drift_s = _DRIFT * abs(host_s - self._at_s)
            # If the stamp is of the start, a longer exposure lets the frame come later after it.
            longer_s = max(0.0, exposure_s - self._exposure_s)
            ahead_s = max(ahead_s, self._ahead_s - drift_s - longer_s)
        self._ahead_s, self._at_s, self._exposure_s = ahead_s, host_s, exposure_s
        return self._first[1] + camera_s - ahead_s
