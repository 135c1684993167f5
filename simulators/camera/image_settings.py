"""What settings of a camera do to its frames beyond region, exposure and gain: to the counts, and to their time.

The names are those of the SFNC and of makers' feature lists; the effects are those of their manuals, in their simplest
form. This list is the simulator's own: the driver has another, by patterns, of what has to be off.
"""

import math
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from simulators.camera.exposure import ExposureInfo

_TEST_PICTURES = ("TestPattern", "TestImageSelector", "TestMode", "IRTestPattern")
_SEQUENCERS = ("SequencerMode", "SequenceEnable", "pgrHDRModeEnabled", "HDR_Mode")
_TABLES = ("LUTEnable", "ContrastEnable", "BslContrastMode", "ContrastMode")
_FILTERS = ("SharpeningEnable", "SharpnessEnabled", "DenoisingEnable", "MedianFilter", "EdgeFilter", "ConvolutionMode")
_DELAYS = ("TriggerDelay", "TriggerDelayAbs", "FrameStartTriggerDelay", "TrigDelay")
_OFF = ("Off", "None", "Disabled", "Linear", "linear", "Normal", "NoTest", "Manual")


class Settings(Protocol):
    """The interface to a camera's features."""

    def number(self, name: str) -> float | None:
        """A number, or None where the camera has it not."""

    def entry(self, name: str) -> str | None:
        """The chosen entry of an enumeration; "Off" or "On" of a flag; None where the camera has it not."""


def _is_on(settings: Settings, names: tuple[str, ...]) -> bool:
    return any((entry := settings.entry(name)) is not None and not entry.endswith(_OFF) for name in names)


def delay_s(settings: Settings) -> float:
    """Time from a trigger to the start of its exposure."""
    if settings.entry("TriggerDelayEnabled") == "Off":
        return 0.0
    return max((settings.number(name) or 0.0 for name in _DELAYS), default=0.0) * 1e-6


def exposed(settings: Settings, info: ExposureInfo) -> ExposureInfo:
    """The exposure as it is made: automatic modes and sequencers change it from frame to frame."""
    factor = 1.0
    if _is_on(settings, ("ExposureAuto",)):
        factor *= 1 + 0.3 * math.sin(info.frame_id)
    if _is_on(settings, _SEQUENCERS):
        factor *= 0.5 if info.frame_id % 2 else 1.0
    return replace(info, exposure_s=info.exposure_s * factor)


def processed(settings: Settings, info: ExposureInfo, counts: NDArray[np.uint16], bits: int) -> NDArray[np.uint16]:
    """Counts as the camera sends them, of those that its sensor gives in so many bits."""
    top = (1 << bits) - 1
    if _is_on(settings, _TEST_PICTURES) or settings.entry("BsliAtpEnab") == "On":
        return np.broadcast_to(np.arange(counts.shape[1]) % (top + 1), counts.shape).astype(np.uint16)
    value: NDArray[Any] = counts
    if _is_on(settings, ("GainAuto", "BlackLevelAuto", "pgrExposureCompensationAuto", "ContrastAuto")):
        value = value * (1 + 0.2 * math.sin(2 * info.frame_id))
    if _is_on(settings, ("BalanceWhiteAuto",)):
        value = value.astype(float)
        value[::2, ::2] *= 1.2 + 0.3 * math.sin(info.frame_id)
    if _is_on(settings, _FILTERS):
        value = value.astype(float)
        value = (np.roll(value, 1, 1) + 2 * value + np.roll(value, -1, 1)) / 4
    if _is_on(settings, _TABLES):
        value = top * np.sin(math.pi / 2 * np.clip(value / top, 0, 1))
    gamma = settings.number("Gamma")
    if gamma and "Off" not in (settings.entry("GammaEnable"), settings.entry("GammaEnabled")):
        value = top * np.clip(value / top, 0, 1) ** gamma
    if settings.entry("CrosshairOverlay") == "On":
        value = value.copy()
        value[value.shape[0] // 2] = top
    if shift := settings.number("DigitalShift"):
        value = value * 2.0**shift
    out = counts if value is counts else np.clip(np.rint(value), 0, top).astype(np.uint16)
    lost_bits = max(0, bits - _converter_bits(settings, bits))
    if lost_bits:
        out = out >> np.uint16(lost_bits) << np.uint16(lost_bits)
    if any(settings.entry(name) == "On" for name in ("GevSCPSBigEndian", "pgrPixelBigEndian")) and bits > 8:
        out = out.byteswap() & np.uint16(top)
    return out


def _converter_bits(settings: Settings, otherwise: int) -> int:
    entry = settings.entry("AdcBitDepth") or settings.entry("SensorBitDepth") or settings.entry("BslSensorBitDepth")
    digits = "".join(letter for letter in entry or "" if letter.isdigit())
    return int(digits) if digits else otherwise
