"""Setting a camera up through Aravis, each part in the order that cameras need, and reading all of it back."""

import logging
import re
from typing import Any, Literal

from drivers import genicam
from drivers.acquisition_status import AcquisitionStatus
from drivers.aravis_config import Config
from drivers.aravis_library import interface_of
from drivers.camera import CameraSettings
from drivers.errors import CameraError, SettingRefused, ignore_refusals
from drivers.exposure_and_gain import RATE_CONTROL, ExposureAndGain
from drivers.genicam import Features
from drivers.neutral_features import NeutralFeatures
from drivers.pixel_formats import PixelFormat, pixel_format, pixel_format_of

log = logging.getLogger(__name__)

# Fits every Ethernet; jumbo frames have to be asked for, because a switch in between may drop them.
_DEFAULT_PACKET_BYTES = 1500
# A difference on read-back that is rounding on cameras that state no step.
_BLACK_LEVEL_FLOOR = 1.0
# How near to a whole number the sensor's size over that of a frame is where pixels are binned or left out.
_WHOLE = 0.02
# Features behind the settings of `structure_of`.
_BEHIND = {
    "pixel_format": ("PixelFormat",),
    "width": ("Width",),
    "height": ("Height",),
    "offset_x": ("OffsetX",),
    "offset_y": ("OffsetY",),
    "binning": ("BinningHorizontal", "BinningVertical"),
    "decimation": ("DecimationHorizontal", "DecimationVertical"),
    "reverse_x": ("ReverseX",),
    "reverse_y": ("ReverseY",),
}


class Setup:
    """What is set on one camera.

    Attributes
    ----------
    interface : name and MTU of the network interface that leads to the camera.
    exposure_s : exposure as read back.
    size : width and height of a frame as read back.
    hardware : True if an input line triggers.
    status : what the camera tells of its trigger and its exposure.
    """

    def __init__(self, name: str, config: Config, aravis: Any, camera: Any, *, features: Features) -> None:
        self._name = name
        self._config = config
        self._aravis = aravis
        self._camera = camera
        self._features = features
        self.is_gige = bool(camera.is_gv_device())
        self.interface = self._find_interface() if self.is_gige else None
        self.exposure_s = 0.0
        self.size = (0, 0)
        self.hardware = False
        self.status = AcquisitionStatus(None)
        self.light = ExposureAndGain(name, features, config.gain_unit, config.gain_raw_per_db)
        self._neutral = NeutralFeatures(name, features, config.user_set, config.features)
        self._delay_s = 0.0
        self.converter_bits: int | None = None

    @property
    def light_s(self) -> float:
        """Time from a trigger to the end of its exposure."""
        return self._delay_s + self.exposure_s

    def warnings(self) -> list[str]:
        """Settings that could not be brought to a known state, in words."""
        return list(self._neutral.remarks)

    def release(self) -> None:
        """Drop the reference to the camera."""
        self._camera = None

    def pixel_format(self) -> PixelFormat:
        """The pixel format that the camera is set to now; raises UnknownPixelFormat if it is not known here."""
        with self._features.asking("read PixelFormat"):
            return pixel_format_of(int(self._camera.get_pixel_format()), self._camera.get_pixel_format_as_string())

    def packet_size(self) -> int | None:
        """Bytes of a GigE Vision packet with its headers; None for another kind of link."""
        with self._features.asking("read the packet size"):
            return int(self._camera.gv_get_packet_size()) if self.is_gige else None

    def _find_interface(self) -> tuple[str, int] | None:
        address = self._camera.get_device().get_interface_address().get_address().to_string()
        found = interface_of(address)
        wanted = self._config.interface
        if wanted is not None and (found is None or found[0] != wanted):
            raise CameraError(
                f"open camera {self._name} over {wanted}",
                f"it is reached over {found[0] if found else address}",
                "Plug it into the interface that the rig file names, or change `interface` there",
            )
        return found

    def set_structure(self, settings: CameraSettings) -> None:
        """Pixel format, region, binning, packets and trigger: the acquisition must be stopped."""
        features = self._features
        for setting, names in _BEHIND.items():
            if getattr(settings, setting) is not None:
                self._require_free(setting, *names)
        # First, because it may set anything; chunks change the payload and are switched on where they are wanted.
        self._neutral.establish()
        if "ChunkModeActive" not in self._config.features:
            features.switch_off("ChunkModeActive")
        if not {*RATE_CONTROL} & self._config.features.keys():
            self.light.free_rate()
        if settings.pixel_format is not None:
            self._set_pixel_format(settings.pixel_format)
        self._clear_offsets()
        self._set_factors(settings)
        self._set_region(settings)
        for name, value in self._config.features.items():
            features.set_value(name, value)
        if self.is_gige:
            self._set_packet_size(settings.packet_size or self._config.packet_size)
        elif settings.packet_size is not None:
            raise self._features.refused(f"packet_size {settings.packet_size}", "this camera is not on Ethernet")
        self._set_trigger(settings.trigger)
        if "GainSelector" not in self._config.features:
            self.light.select_gain()
        fmt = self.pixel_format()
        if not {*genicam.CONVERTER_BITS} & self._config.features.keys():
            self.light.set_converter(fmt)
        if self._config.bits is not None and self._config.bits > fmt.bits - self._config.shift:
            raise self._features.refused(
                f"bits {self._config.bits} and shift {self._config.shift} in the rig file",
                f"{fmt.name} holds {fmt.bits} bits",
            )

    def _set_factors(self, settings: CameraSettings) -> None:
        for what, factor in (("Binning", settings.binning), ("Decimation", settings.decimation)):
            if factor is None:
                self._leave_out_none(what)
            else:
                self._set_both(what, factor)
        self._set_reversed("ReverseX", settings.reverse_x)
        self._set_reversed("ReverseY", settings.reverse_y)

    def _set_pixel_format(self, name: str) -> None:
        if name in self._features.choices("PixelFormat"):
            # Before the camera is changed: one that it sends and that is not known here cannot be taken.
            pixel_format(name)
        self._features.set_choice("PixelFormat", name)

    def _set_both(self, what: str, factor: int | None) -> None:
        """Set the binning or decimation along both axes; 1 where the camera has none is no request."""
        names = (f"{what}Horizontal", f"{what}Vertical")
        if factor is None or (factor == 1 and self._features.find(names[:1]) is None):
            return
        for name in names:
            self._features.set_number((name,), factor)

    def _leave_out_none(self, what: str) -> None:
        """Undo a binning or decimation that another program left; one that stays is read back and recorded."""
        for axis in ("Horizontal", "Vertical"):
            name = f"{what}{axis}"
            if name not in self._config.features and self._one_factor(name) not in (None, 1.0):
                with ignore_refusals():
                    if self._features.kind(name) == "choice":
                        ones = [entry for entry in self._features.choices(name) if re.sub(r"\D", "", entry) == "1"]
                        self._features.set_value(name, ones[0] if ones else "Off")
                    else:
                        self._features.set_number((name,), 1)

    def _one_factor(self, name: str) -> float | None:
        """Factor along one axis: a number, or an entry such as X2; None where the camera has none."""
        if self._features.find((name,)) is None:
            return None
        if self._features.kind(name) != "choice":
            factor = self._features.number((name,))
        else:
            digits = re.sub(r"\D", "", self._features.text((name,)))
            factor = float(digits) if digits else 1.0
        if factor is not None and factor < 1:
            raise self._features.refused(f"read {name}", f"it is {factor:g}, which is no factor. Set it in `features`")
        return factor

    def _factor(self, what: str) -> int | None:
        """Binning or decimation as it is, whoever set it; None where the camera has none."""
        factors = [self._one_factor(f"{what}{axis}") for axis in ("Horizontal", "Vertical")]
        known = {round(factor) for factor in factors if factor is not None}
        if len(known) > 1:
            raise self._features.refused(
                f"read {what}",
                f"columns and rows have {factors[0]:g} and {factors[1]:g}, a capture holds one factor for both. "
                f"Give `{what.lower()}` in the settings",
            )
        return next(iter(known), None)

    def _untold_factor(self, told: int) -> int:
        """How many times fewer columns or rows than the sensor has can be had, beyond the binning and decimation told.

        Makers have more ways than those two features: skipping, binning by another engine that a selector hides.
        """
        found = 1
        for sensor, most in (("SensorWidth", "WidthMax"), ("SensorHeight", "HeightMax")):
            whole, sent = self._features.number((sensor,)), self._features.number((most,))
            if whole and sent:
                ratio = whole / (sent * self.pixel_format().scale * told)
                if abs(ratio - round(ratio)) < _WHOLE * ratio:
                    found = max(found, round(ratio))
        return found

    def _set_reversed(self, name: str, wanted: bool | None) -> None:
        if not wanted:
            self._features.switch_off(name)
        elif self._features.find((name,)) is None:
            raise self._features.refused(f"switch {name} on", "this camera has no such feature")
        else:
            self._features.set_flag(name, True)

    def _clear_offsets(self) -> None:
        if "Region0" in self._features.choices("RegionSelector") and "RegionSelector" not in self._config.features:
            self._features.set_choice("RegionSelector", "Region0")
        # They limit the size. One at zero is left alone: while the size is too large for a new binning, zero is more
        # than its limit.
        for offset in ("OffsetX", "OffsetY"):
            if self._features.number((offset,)):
                self._features.set_number((offset,), 0)

    def _set_region(self, settings: CameraSettings) -> None:
        # First the size, which limits the offsets. Rows and columns are those of the frames.
        scale = self.pixel_format().scale
        for offset, size, start, length in (
            ("OffsetX", "Width", settings.offset_x, settings.width),
            ("OffsetY", "Height", settings.offset_y, settings.height),
        ):
            first = self._whole(offset, start or 0, scale)
            most = self._features.largest(size, first) if length is None else self._whole(size, length, scale)
            self._features.set_number((size,), most)
            if first:
                self._features.set_number((offset,), first)

    def _whole(self, name: str, pixels: int, scale: int) -> int:
        if pixels % scale:
            raise self._features.refused(
                f"set {name} to {pixels}", f"this format has {scale} x {scale} of them together"
            )
        return pixels // scale

    def _set_packet_size(self, packet_size: int | None) -> None:
        interface, mtu = self.interface or ("", None)
        if packet_size is None:
            packet_size = min(_DEFAULT_PACKET_BYTES, mtu or _DEFAULT_PACKET_BYTES)
        if mtu is not None and packet_size > mtu:
            raise self._features.refused(f"packet_size {packet_size}", f"interface {interface} has an MTU of {mtu}")
        with self._features.asking(f"set packet size to {packet_size}"):
            self._camera.gv_set_packet_size_adjustment(self._aravis.GvPacketSizeAdjustment.NEVER)
            self._camera.gv_set_packet_size(packet_size)
            back = int(self._camera.gv_get_packet_size())
        if back != packet_size:
            raise self._features.refused(f"packet_size {packet_size}", f"it reads back {back}")

    def _set_trigger(self, trigger: Literal["software", "hardware"] | None) -> None:
        features = self._features
        if trigger is not None:
            self.hardware = trigger == "hardware"
        frame = self._frame_trigger()
        with features.asking("set AcquisitionMode to Continuous"):
            self._camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
            # Every trigger off first: one left on by another program would hold frames back.
            self._camera.clear_triggers()
        if features.find(("ExposureMode",)) is not None:
            features.set_choice("ExposureMode", "Timed")
        if frame is not None:
            features.set_choice("TriggerSelector", frame)
        features.set_choice("TriggerSource", self._config.trigger_line if self.hardware else "Software")
        edge = "TriggerActivation"
        if self.hardware and edge not in self._config.features and features.find((edge,)) is not None:
            features.set_choice(edge, self._config.trigger_edge)
        features.set_choice("TriggerMode", "On")
        self.status = AcquisitionStatus(features)

    def _frame_trigger(self) -> str | None:
        """The entry of TriggerSelector whose trigger starts an exposure; None for a camera without that selector."""
        entries = self._features.choices("TriggerSelector")
        # Before SFNC 2 some cameras call it ExposureStart.
        frame = next((entry for entry in ("FrameStart", "ExposureStart") if entry in entries), None)
        reason = f"its TriggerSelector offers only {', '.join(entries)}" if entries and frame is None else None
        if self._features.kind("TriggerMode") != "choice":
            reason = "it has no TriggerMode"
        if reason is not None:
            raise SettingRefused(
                f"camera {self._name}, one frame at each trigger",
                reason,
                "Use a camera that exposes when it is triggered: others expose while the axes move",
            )
        return frame

    def set_light(self, settings: CameraSettings, *, stopped: bool) -> None:
        """Exposure, gain and black level: no exposure is under way when this is called.

        `stopped` is True while the acquisition is stopped: the frame rate can be changed then.
        """
        features = self._features
        if settings.exposure_s is not None:
            self.light.set_exposure(settings.exposure_s, stopped=stopped)
        if settings.gain_db is not None:
            self._require_free("gain_db", *genicam.GAIN_DB, *genicam.GAIN_RAW)
            self.light.set_gain(settings.gain_db)
        if settings.black_level is not None:
            self._require_free("black_level", *genicam.BLACK_LEVEL)
            features.set_number(genicam.BLACK_LEVEL, settings.black_level, floor=_BLACK_LEVEL_FLOOR)

    def require_known_state(self) -> None:
        """Read once more what must do nothing, after everything is set. Raises SettingRefused where it does not."""
        self._neutral.require()
        self._delay_s = self.light.delay_s(self._config.features)
        self.converter_bits = self.light.converter_bits()

    def _require_free(self, setting: str, *names: str) -> None:
        """One of two values for the same thing would be dropped in silence."""
        for name in names:
            if name in self._config.features:
                raise self._features.refused(
                    f"{name} in `features`", f"{setting} is given as well. Leave one of them out"
                )

    def read_back(self, frame_average: int | None) -> CameraSettings:
        """Every setting as the camera has it now."""
        features = self._features
        self.exposure_s = self.light.exposure_s() or 0.0
        binning, decimation = self._factor("Binning"), self._factor("Decimation")
        untold = self._untold_factor((binning or 1) * (decimation or 1))
        if untold > 1:
            log.warning(
                "camera %s: frames have %d times fewer pixels along an axis than the sensor, and neither Binning nor "
                "Decimation tells why; recorded as decimation",
                self._name,
                untold,
            )
            decimation = (decimation or 1) * untold
        with features.asking("read the region"):
            left, top, width, height = self._camera.get_region()
        self.size, fmt = (int(width), int(height)), self.pixel_format()
        return CameraSettings(
            exposure_s=self.exposure_s or None,
            gain_db=self.light.gain_db(),
            black_level=features.number(genicam.BLACK_LEVEL),
            pixel_format=fmt.name,
            width=fmt.scale * int(width),
            height=fmt.scale * int(height),
            offset_x=fmt.scale * int(left),
            offset_y=fmt.scale * int(top),
            binning=binning,
            decimation=decimation,
            reverse_x=features.optional_flag("ReverseX"),
            reverse_y=features.optional_flag("ReverseY"),
            packet_size=self.packet_size(),
            frame_average=frame_average or 1,
            trigger="hardware" if self.hardware else "software",
        )

    def applied(self) -> CameraSettings:
        """What decides how bright a frame is and which way it lies, as the camera has it now; a few registers."""
        return CameraSettings(
            exposure_s=self.light.exposure_s() or None,
            gain_db=self.light.gain_db(),
            black_level=self._features.number(genicam.BLACK_LEVEL),
            reverse_x=self._features.optional_flag("ReverseX"),
            reverse_y=self._features.optional_flag("ReverseY"),
        )
