"""The time of an exposure as the camera sends it behind the image (chunk `Timestamp` of the SFNC), where it can.

The stamp that every frame carries is that of its transfer; what instant it means differs between makers. The chunk's is
the start of the frame. Tried on a simulated camera that sends chunks; on a real one unverified.
"""

import logging
from typing import Any

from drivers.aravis_stream import Arrival
from drivers.errors import CameraError, CameraLost, FrameLost
from drivers.genicam import Features

log = logging.getLogger(__name__)

_TICK_FREQUENCY = ("GevTimestampTickFrequency",)


class ChunkStamps:
    """Time stamps behind the images of a stream that is about to start.

    Parameters
    ----------
    name : name of the camera in messages.
    camera : the open `Aravis.Camera`.
    features : of that camera.
    glib_error : GLib's exception class.
    wanted : False leaves the camera as it is.
    """

    def __init__(self, name: str, camera: Any, features: Features, glib_error: Any, *, wanted: bool) -> None:
        self._name, self._glib_error = name, glib_error
        self._parser: Any = None
        if not wanted or "Timestamp" not in features.choices("ChunkSelector"):
            return
        try:
            with features.asking("send the time of the exposure behind the image"):
                camera.set_chunk_mode(True)
                camera.set_chunk_state("Timestamp", True)
                self._parser = camera.create_chunk_parser()
        except CameraLost:
            raise
        except CameraError as error:
            log.warning("camera %s: no time stamps behind the images: %s", name, error)
            features.switch_off("ChunkModeActive")
        self._ticks_per_s = features.number(_TICK_FREQUENCY) or 1e9

    def time_ns(self, arrival: Arrival) -> int:
        """The camera's time of an exposure in nanoseconds: of the chunk, or of the transfer where none is asked for.

        Raises FrameLost: the chunk did not come. The time of the transfer is another instant than that of the other
        frames.
        """
        if self._parser is None:
            return arrival.camera_time_ns
        try:
            ticks = int(self._parser.get_integer_value(arrival.buffer, "ChunkTimestamp"))
        except self._glib_error as error:
            raise FrameLost(
                f"camera {self._name}, take a frame",
                f"frame {arrival.frame_id} has no time behind its image",
                "If it stays so, `chunk_timestamp: false` at the camera in the rig file does without",
            ) from error
        return ticks if self._ticks_per_s == 1e9 else round(ticks * 1e9 / self._ticks_per_s)
