"""Any GenICam camera through Aravis: GigE Vision and USB3 Vision.

Names of features are those of the GenICam SFNC with the older ones as second choice (`drivers/genicam.py`). Tried on
Aravis 0.8.26 and its loopback GigE Vision camera; not yet on a camera of a maker.
"""

import contextlib
import logging
import threading
import time
from collections import Counter
from typing import Any, NoReturn

from drivers import genicam
from drivers.aravis_chunks import ChunkStamps
from drivers.aravis_config import Config, structure_of
from drivers.aravis_identity import identify
from drivers.aravis_library import load_aravis, open_camera
from drivers.aravis_setup import Setup
from drivers.aravis_stream import Arrival, FrameStream, counts_of, let_go, other_layout
from drivers.camera import Camera, CameraIdentity, CameraSettings, StreamStatistics
from drivers.camera_clock import CameraClock
from drivers.clock import REAL, Clock
from drivers.errors import CameraError, FrameLost
from drivers.frame import Frame
from drivers.genicam import Features
from drivers.pixel_formats import PixelFormat

__all__ = ["AravisCamera", "Config", "open"]

log = logging.getLogger(__name__)

# Ctrl-C is noticed when a C call returns, so no call waits longer than this.
_SLICE_S = 0.1
# The slowest link that still makes sense for a camera, 100 Mbit/s, and a margin on top.
_SLOWEST_BYTES_S = 10e6
_TRANSFER_MARGIN_S = 1.0
# How much shorter than it reads back an exposure may be.
_EARLY, _EARLY_S = 0.02, 1e-3
_CHECK_LINK = "Check cable, packet size and network load (acquire doctor measures the packet loss)"


def open(name: str, config: Config, clock: Clock = REAL) -> "AravisCamera":
    """Open the camera and take control of it; nothing is set and nothing is exposed.

    Parameters
    ----------
    clock : what exposures and deadlines are counted by. Aravis' own time limits are always real time.

    Raises
    ------
    CameraNotFound, CameraBusy, CameraError
        Not there (what is there is listed), controlled by another program, or Aravis is not installed.
    """
    aravis, glib_error = load_aravis()
    camera = open_camera(name, config.device, aravis, glib_error)
    return AravisCamera(name, config, aravis, glib_error, camera=camera, clock=clock)


class AravisCamera(Camera):
    """A camera opened by `open`."""

    def __init__(
        self, name: str, config: Config, aravis: Any, glib_error: Any, *, camera: Any, clock: Clock = REAL
    ) -> None:
        super().__init__(name, config.retakes)
        self._clock = clock
        self._config = config
        self._aravis = aravis
        self._camera = camera
        self._features = Features(name, aravis, glib_error, camera)
        self.setup = Setup(name, config, aravis, camera, features=self._features)
        self._glib_error = glib_error
        self._stream: FrameStream | None = None
        self._chunks: ChunkStamps | None = None
        self._camera_clock = CameraClock(name)
        self._counted: Counter[str] = Counter()
        self._stale = 0
        self._asked_structure: tuple[object, ...] | None = None
        self._format: PixelFormat | None = None
        # Exposure under way: sent at these host times, not collected yet.
        self._outstanding = False
        self._sent_unix_s = 0.0
        self._sent_s = self._heard_s = 0.0
        # How long after the trigger a whole frame came that cannot be of this exposure.
        self._early_s: float | None = None
        self._last_id: int | None = None

    # --- identity ----------------------------------------------------------------------------------------

    @property
    def bits(self) -> int:
        """Real bits of a pixel: those of the format, or `bits` of the rig file for a wider container."""
        return self._config.bits or self._pixel_format().bits - self._config.shift

    @property
    def bins_like_with_like(self) -> bool:
        """True where the rig file says that the camera bins only pixels behind the same polarizer."""
        return self._config.mosaic_binning == "like_with_like"

    def describe(self) -> CameraIdentity:
        """Which camera this is and how it is connected."""
        self._require_open()
        return identify(
            self._config,
            self._aravis,
            self._camera,
            self._features,
            setup=self.setup,
            fmt=self._pixel_format(),
            bits=self.bits,
        )

    def temperature_c(self) -> float | None:
        """Temperature of the camera in degrees Celsius; None where it has no sensor."""
        self._require_open()
        return self._features.number(genicam.TEMPERATURE_C)

    def forget_clock(self) -> None:
        """The host's clock was set: compare it with the camera's anew."""
        self._camera_clock.forget_all()

    def node_map(self) -> dict[str, str]:
        """Every GenICam feature that can be read now, with its value; takes about a millisecond a feature."""
        self._require_open()
        with self._features.asking("read the node map"):
            return self._features.dump()

    def warnings(self) -> list[str]:
        """Settings that could not be brought to a known state, in words."""
        return self.setup.warnings()

    def _converter_bits(self) -> int | None:
        return self.setup.converter_bits

    def _pixel_format(self) -> PixelFormat:
        return self.setup.pixel_format() if self._format is None else self._format

    # --- settings ----------------------------------------------------------------------------------------

    def _do_configure(self, settings: CameraSettings) -> CameraSettings:
        self._discard_outstanding()
        settings = self._config.settings.model_copy(update=settings.model_dump(exclude_none=True))
        structure = structure_of(settings)
        exposure_s = settings.exposure_s
        fits = exposure_s is None or exposure_s == self.setup.exposure_s or self.setup.light.fits(exposure_s)
        if self._stream is None or structure != self._asked_structure or not fits:
            self._stop()
            self._asked_structure = None
            self.setup.set_structure(settings)
            self.setup.set_light(settings, stopped=True)
            self.setup.require_known_state()
            self._format = self.setup.pixel_format()
            self._start()
            self._asked_structure = structure
        else:
            self._drain()
            self.setup.set_light(settings, stopped=False)
        return self.setup.read_back(settings.frame_average)

    def _do_applied(self) -> CameraSettings:
        return self.setup.applied()

    # --- stream ------------------------------------------------------------------------------------------

    def _start(self) -> None:
        wanted = self._config.chunk_timestamp and "ChunkModeActive" not in self._config.features
        # It adds to the payload.
        self._chunks = ChunkStamps(self.name, self._camera, self._features, self._glib_error, wanted=wanted)
        with self._features.asking("start the stream"):
            payload = int(self._camera.get_payload())
            self._stream = FrameStream(
                self._aravis, self._camera, payload, self._config.buffers, resend=self._config.resend
            )
            self._camera.start_acquisition()
        self._last_id = None
        self._camera_clock.forget()

    def _stop(self) -> None:
        if self._stream is None:
            return
        with self._features.asking("stop the stream"):
            self._camera.stop_acquisition()
        let_go([self._forget_stream()])

    def _forget_stream(self) -> FrameStream | None:
        stream, self._stream = self._stream, None
        if stream is not None:
            self._counted.update(stream.counters())
        return stream

    def _restart(self) -> None:
        """Start anew with a new stream after a frame that never came, so that it cannot come later."""
        # Many cameras number from 1 again, and Aravis throws away a number up to 100 before the last in one stream.
        self._outstanding = False
        self._drain()
        self._stop()
        self._start()

    def _live_stream(self) -> FrameStream:
        if self._stream is None:
            raise CameraError(f"camera {self.name}", "the stream is not running", "Call configure() again")
        return self._stream

    def _drain(self) -> None:
        """Throw away every frame that waits: it belongs to no exposure that is still asked for."""
        stream = self._live_stream()
        while (arrival := stream.take(0)) is not None:
            self._throw_away(stream, arrival)

    def _throw_away(self, stream: FrameStream, arrival: Arrival) -> None:
        stream.give_back(arrival)
        self._last_id = arrival.frame_id or self._last_id
        if arrival.whole:
            self._stale += 1
            if self._outstanding and arrival.first_packet_s >= self._sent_unix_s:
                self._early_s = arrival.first_packet_s - self._sent_unix_s
            log.warning("camera %s: frame %d is stale and was discarded", self.name, arrival.frame_id)

    # --- exposures ---------------------------------------------------------------------------------------

    def _do_trigger(self) -> None:
        self._discard_outstanding()
        self._drain()
        self._check_control("trigger")
        if not self.setup.hardware:
            self._wait_armed()
        # Real time: frames carry the time of day at which their first packet came.
        self._sent_unix_s = time.time()
        self._sent_s = self._clock.now_s()
        self._outstanding = True
        self._early_s = None
        if not self.setup.hardware:
            self._features.command("TriggerSoftware")
            # A command that is lost is sent again after up to a second, and the camera begins when it hears it.
            self._heard_s = self._clock.now_s()

    def _wait_armed(self) -> None:
        """Wait until the camera heeds a trigger: one that comes too early is ignored."""
        deadline_s = self._clock.now_s() + self.setup.light_s + self._transfer_s()
        while not self.setup.status.armed():
            if self._clock.now_s() > deadline_s:
                self._restart()
                raise self._frame_lost(
                    f"not ready for a trigger within {self.setup.light_s + self._transfer_s():.2f} s",
                    "Is it in continuous acquisition with TriggerMode On? Another trigger selector may hold it back",
                )
            self._check_control("wait until the trigger is armed")
            self._clock.sleep_s(0.001)

    def _do_wait_exposed(self) -> None:
        stream = self._live_stream()
        if self.setup.hardware:
            self._wait_for_hardware_trigger(stream)
            return
        end_s = self._heard_s + self.setup.light_s
        self._sleep_until(end_s - max(_EARLY * self.setup.exposure_s, _EARLY_S))
        while (arrival := stream.take(0)) is not None:
            if self._is_ours(arrival):
                stream.unread(arrival)
                break
            self._throw_away(stream, arrival)
        self._sleep_until(end_s)
        if not self.setup.status.tells_exposing:
            self._sleep_until(end_s + self._config.trigger_latency_s)
            return
        deadline_s = end_s + _TRANSFER_MARGIN_S
        while self.setup.status.exposing():
            if self._clock.now_s() > deadline_s:
                self._restart()
                raise self._frame_lost(
                    f"it still exposes {_TRANSFER_MARGIN_S:g} s after the exposure should have ended"
                )
            self._clock.sleep_s(0.001)

    def _wait_for_hardware_trigger(self, stream: FrameStream) -> None:
        # The end of the exposure is not visible, so it counts as ended when the frame is there.
        deadline_s = self._sent_s + self._config.trigger_timeout_s + self.setup.light_s + self._transfer_s()
        while not stream.has_arrival():
            if self._clock.now_s() > deadline_s:
                self._restart()
                raise self._frame_lost(
                    f"no signal at {self._config.trigger_line} within {self._config.trigger_timeout_s:g} s",
                    "Check the trigger's cable and level, and trigger_line and trigger_edge in the rig file",
                )
            self._check_control("wait for the hardware trigger")
            self._clock.sleep_s(0.001)

    def _do_frame(self) -> Frame:
        stream = self._live_stream()
        deadline_s = self._sent_s + self.setup.light_s + self._transfer_s()
        if self.setup.hardware:
            deadline_s += self._config.trigger_timeout_s
        while True:
            arrival = stream.take(_SLICE_S)
            if arrival is None:
                self._check_control("wait for the frame")
                if self._clock.now_s() > deadline_s:
                    # A camera that is gone says so here, seconds before the heartbeat would.
                    self._restart()
                    raise self._no_frame()
                continue
            if not self._is_ours(arrival):
                self._throw_away(stream, arrival)
                continue
            if not arrival.whole:
                self._give_up(stream, arrival)
            self._outstanding = False
            self._last_id = arrival.frame_id
            try:
                return self._make_frame(arrival)
            finally:
                stream.give_back(arrival)

    def _is_ours(self, arrival: Arrival) -> bool:
        """True unless the frame left the camera before the exposure under way can have ended, or has an old number."""
        exposure_s = 0.0 if self._config.answers_early else self.setup.exposure_s
        light_s = 0.0 if self._config.answers_early else self.setup.light_s
        came_s = self._camera_clock.came_s(arrival.camera_time_ns, arrival.first_packet_s, exposure_s)
        ended_s = self._sent_unix_s + light_s - max(_EARLY * exposure_s, _EARLY_S)
        # Without its first packet a frame has no time; it is not whole either.
        return arrival.follows(self._last_id) and (arrival.first_packet_s <= 0 or came_s >= ended_s)

    def _give_up(self, stream: FrameStream, arrival: Arrival) -> NoReturn:
        stream.give_back(arrival)
        if arrival.frame_id:
            self._outstanding = False
            self._last_id = arrival.frame_id
        else:
            # Without its first packet nobody can tell whose frame it was, so ours might still come.
            self._restart()
        raise self._frame_lost(f"frame {arrival.frame_id or 'without a number'} is not whole ({arrival.status})")

    def _make_frame(self, arrival: Arrival) -> Frame:
        fmt, size = self._pixel_format(), self.setup.size
        if wrong := other_layout(arrival, fmt, size):
            raise self._frame_lost(wrong)
        pixels = counts_of(arrival, fmt, size, self.bits, shift=self._config.shift, camera=f"camera {self.name}")
        host_time_s = arrival.first_packet_s if self.setup.hardware else self._sent_unix_s
        time_ns = arrival.camera_time_ns if self._chunks is None else self._chunks.time_ns(arrival)
        return Frame(pixels, arrival.frame_id, time_ns, host_time_s)

    def _discard_outstanding(self) -> None:
        """Wait for an exposure that nobody collected, and throw its frame away."""
        if not self._outstanding or self._stream is None:
            self._outstanding = False
            return
        stream = self._live_stream()
        deadline_s = self._sent_s + self.setup.light_s + self._transfer_s()
        while not self.setup.hardware and self._clock.now_s() < deadline_s:
            arrival = stream.take(_SLICE_S)
            if arrival is None:
                self._check_control("wait for an abandoned exposure")
                continue
            ours = self._is_ours(arrival)
            self._throw_away(stream, arrival)
            if ours:
                self._outstanding = False
                return
        self._restart()

    def _transfer_s(self) -> float:
        return self._pixel_format().payload_bytes(*self.setup.size) / _SLOWEST_BYTES_S + _TRANSFER_MARGIN_S

    def _sleep_until(self, end_s: float) -> None:
        while (rest_s := end_s - self._clock.now_s()) > 0:
            self._clock.sleep_s(min(rest_s, _SLICE_S))
            self._check_control("expose")

    def _check_control(self, what: str) -> None:
        if self._features.control_is_lost():
            raise self._features.lost(what, "its heartbeat stopped")

    def _frame_lost(self, came_back: str, what_to_do: str = _CHECK_LINK) -> FrameLost:
        return FrameLost(f"camera {self.name}, take a frame", came_back, what_to_do)

    def _no_frame(self) -> FrameLost:
        waited_s = self._clock.now_s() - self._sent_s
        if self._early_s is None:
            return self._frame_lost(f"no frame within {waited_s:.2f} s of the trigger")
        return self._frame_lost(
            f"the only frame came {self._early_s:.3f} s after the trigger, before the {self.setup.exposure_s:g} s of "
            "its exposure were over, and was discarded as one of an earlier exposure",
            "Does the camera expose as long as it says, and does nothing else trigger it? A simulated camera that does "
            "not wait for its exposure needs `answers_early: true` in the rig file",
        )

    # --- end ---------------------------------------------------------------------------------------------

    def _do_statistics(self, retakes: int) -> StreamStatistics:
        now = {} if self._stream is None else self._stream.counters()
        total = self._counted + Counter(now)
        return StreamStatistics(
            completed=total["n_completed_buffers"],
            failures=total["n_failures"],
            underruns=total["n_underruns"],
            missing_packets=total["n_missing_packets"],
            resent_packets=total["n_resent_packets"],
            retakes=retakes,
            stale_discarded=self._stale,
        )

    def _do_close(self) -> None:
        lost = self._features.control_is_lost()
        if not lost:
            with contextlib.suppress(CameraError), self._features.asking("stop"):
                self._camera.stop_acquisition()
            lost = self._features.control_is_lost()
        # Control is given up when the last reference goes, and an error's traceback may keep this object.
        left = [self._forget_stream(), self._camera]
        self._camera = self._chunks = None
        self._features.release()
        self.setup.release()
        if lost:
            # Aravis takes leave with four commands, each of which waits 2.5 s for a camera that is gone.
            threading.Thread(target=let_go, args=(left,), name=f"leave camera {self.name}", daemon=True).start()
        else:
            let_go(left)
