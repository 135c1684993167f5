"""Exposure and gain of a camera in seconds and decibels, whatever units, limits and selectors it has for them.

A camera may allow an exposure only up to the time of a frame: Lucid's Triton takes 44 to 47 ms at its default rate,
and 199.8 ms at 5 frames a second with AcquisitionFrameRateEnable (public scripts of its users). So the rate is lowered
where an exposure does not fit, and is not controlled otherwise. `Gain` is in decibels on most cameras, and a factor on
others.
"""

import math
import re
from collections.abc import Collection
from typing import Literal

from drivers import genicam
from drivers.errors import CameraError, CameraLost, SettingRefused, ignore_refusals
from drivers.genicam import Features
from drivers.neutral_features import DELAYS, rule_for
from drivers.pixel_formats import PixelFormat

_UNIT_OF_TIME = re.compile(r"(µ|μ|u|micro|m|milli|n|nano|)\s?s(ec(ond)?s?)?")
_SCALES = {"m": 1e-3, "milli": 1e-3, "n": 1e-9, "nano": 1e-9, "": 1.0}
_DECIBEL, _FACTOR = ("db", "decibel", "decibels"), ("x", "factor", "times", "ratio", "fold", "multiplier")
_RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
#: Features that switch the control of the frame rate on.
RATE_CONTROL = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
_RATE_MODES = (("AcquisitionFrameRateAuto", "Off"), ("AcquisitionFrameRateMode", "Basic"))
# A frame lasts this much longer than its exposure at least.
_LONGER, _LONGER_S = 1.01, 1e-3
# A rate is given up for an exposure that is so much shorter than the one that it was lowered for.
_SHORTER = 0.8
# Differences on read-back that are rounding on cameras that state no step: a sensor row, a tenth of a decibel.
_EXPOSURE_FLOOR_US, _GAIN_FLOOR_DB = 20.0, 0.1
#: Entries of the selector for a capture's gain; the others are set to their neutral value.
_WHOLE_GAIN = ("All", "AnalogAll")


def _plain(unit: str) -> str:
    return unit.strip().strip("[]()").lower()


def _seconds_of(unit: str) -> float | None:
    """Seconds of a unit of time: microseconds, which the SFNC has, where there is none; None for another unit."""
    match = _UNIT_OF_TIME.fullmatch(_plain(unit) or "us")
    return None if match is None else _SCALES.get(match[1], 1e-6)


def gain_unit(unit: str) -> Literal["dB", "factor"] | None:
    """What the unit of a Gain feature means; None where its description does not say."""
    word = _plain(unit)
    return "dB" if word in _DECIBEL else "factor" if word in _FACTOR else None


class ExposureAndGain:
    """Those of one camera.

    Parameters
    ----------
    name : name of the camera in messages.
    gain_unit : {"dB", "factor"} or None
        Unit of Gain from the rig file; None takes the one that the camera's description has.
    raw_per_db : steps of GainRaw for a decibel, for cameras without Gain.
    """

    def __init__(
        self, name: str, features: Features, gain_unit: Literal["dB", "factor"] | None, raw_per_db: float | None
    ) -> None:
        self._name, self._features = name, features
        self._gain_unit, self._raw_per_db = gain_unit, raw_per_db
        self._lowered_for_us: float | None = None

    # --- exposure ----------------------------------------------------------------------------------------

    def fits(self, exposure_s: float) -> bool:
        """True if the exposure can be set while frames are taken: no change of the frame rate is needed."""
        name = self._features.find(genicam.EXPOSURE_US)
        if name is None or self._features.find(RATE_CONTROL) is None:
            return True
        value = exposure_s / self._unit_s(name)
        if self._lowered_for_us is not None and value < _SHORTER * self._lowered_for_us:
            return False
        return value <= self._features.limits(name)[1]

    def free_rate(self) -> None:
        """Let the frame rate follow the triggers: a rate limits the exposure."""
        self._lowered_for_us = None
        for mode, off in (("AcquisitionFrameRateAuto", "Off"), ("AcquisitionFrameRateMode", "Off")):
            if off in self._features.choices(mode):
                self._features.set_choice(mode, off)
        for control in RATE_CONTROL:
            self._features.switch_off(control)

    def set_exposure(self, exposure_s: float, *, stopped: bool) -> None:
        """Set the exposure; the frame rate is lowered where it is limited by it, while the acquisition is stopped.

        Raises SettingRefused: no such feature, out of its limits at the lowest frame rate, or read back different.
        """
        features = self._features
        name = features.find(genicam.EXPOSURE_US)
        unit_s = 1e-6 if name is None else self._unit_s(name)
        value = exposure_s / unit_s
        if name is not None and stopped and value > features.limits(name)[1]:
            self._lower_rate(exposure_s)
            self._lowered_for_us = value
        features.set_number(genicam.EXPOSURE_US, value, floor=_EXPOSURE_FLOOR_US * 1e-6 / unit_s)

    def exposure_s(self) -> float | None:
        """The exposure as read back; None where the camera has no such feature."""
        name = self._features.find(genicam.EXPOSURE_US)
        value = self._features.number(genicam.EXPOSURE_US)
        return None if name is None or value is None else value * self._unit_s(name)

    def delay_s(self, features: Collection[str]) -> float:
        """Time from the trigger of a frame to the start of its exposure, as the camera has it set.

        `features` are those of the rig file, which may have a delay under a name of the maker's.
        """
        enabled = self._features.find(("TriggerDelayEnabled", "TriggerDelayEnable"))
        if enabled is not None and self._features.value(enabled) in (False, "Off"):
            return 0.0
        usual = self._features.find(("TriggerDelay", "TriggerDelayAbs"))
        names = {name for name in (usual, *features) if name is not None and rule_for(name) is DELAYS}
        delays = {name: self._features.number((name,)) or 0.0 for name in names}
        least = {name: 0.0 if name in features else self._features.limits(name)[0] for name in names}
        return max((value * self._unit_s(name) for name, value in delays.items() if value > least[name]), default=0.0)

    def _unit_s(self, name: str) -> float:
        unit = self._features.unit(name)
        unit_s = None if name.endswith("Raw") and not unit else _seconds_of(unit)
        if unit_s is None:
            raise SettingRefused(
                f"camera {self._name}, a time by {name}",
                f"it counts in {unit or 'steps'}, and its description does not say how long one is",
                f"Leave {name} out of `features`, or use a camera that takes times in parts of a second",
            )
        return unit_s

    def _lower_rate(self, exposure_s: float) -> None:
        features = self._features
        control, rate = features.find(RATE_CONTROL), None
        for mode, on in _RATE_MODES:
            if on in features.choices(mode):
                features.set_choice(mode, on)
        if control is not None:
            features.set_value(control, "On" if features.kind(control) == "choice" else True)
        rate = features.find(_RATE)
        if rate is None:
            return
        low, high = features.limits(rate)
        rate_hz = 1.0 / (_LONGER * exposure_s + _LONGER_S)
        try:
            features.set_number((rate,), min(max(rate_hz, low), high), floor=0.05 * rate_hz)
        except CameraLost:
            raise
        except CameraError as error:
            raise SettingRefused(
                f"camera {self._name}, set an exposure of {exposure_s:g} s",
                f"the frame rate limits it and does not take {rate_hz:.3g} Hz ({error.came_back})",
                "Give a shorter exposure_s in the plan",
            ) from error

    # --- gain --------------------------------------------------------------------------------------------

    def select_gain(self) -> None:
        """Select the gain of all pixels, and let those of taps, colours and the digital part do nothing."""
        features, selector = self._features, "GainSelector"
        entries = features.choices(selector)
        overall = next((entry for entry in _WHOLE_GAIN if entry in entries), None)
        if overall is None:
            return
        for entry in entries:
            if entry not in _WHOLE_GAIN or (entry == "All" and overall != "All"):
                features.set_choice(selector, entry)
                self._neutral_gain()
        features.set_choice(selector, overall)

    def _neutral_gain(self) -> None:
        name = self._features.find((*genicam.GAIN_DB, *genicam.GAIN_RAW))
        if name is None:
            return
        low, high = self._features.limits(name)
        neutral = {"dB": 0.0, "factor": 1.0, None: low}[self._unit_of_gain(name)]
        # One that is selected and locked: `All` sets it.
        with ignore_refusals():
            self._features.set_number((name,), min(max(neutral, low), high), floor=_GAIN_FLOOR_DB)

    def set_gain(self, gain_db: float) -> None:
        """Set the gain.

        Raises SettingRefused: no such feature, its unit is not known, out of its limits, or read back different.
        """
        features = self._features
        name = features.find(genicam.GAIN_DB)
        if name is None and self._raw_per_db is not None:
            features.set_number(genicam.GAIN_RAW, gain_db * self._raw_per_db)
            return
        if name is None:
            raise self._refused(
                gain_db,
                "this camera has no Gain in decibels; with GainRaw, `gain_raw_per_db` is needed in the rig file",
            )
        unit = self._unit_of_gain(name)
        if unit is None:
            raise self._refused(
                gain_db,
                f"the unit of {name} is {features.unit(name)!r} in the camera's description. "
                "Write `gain_unit: dB` or `gain_unit: factor` at the camera, as its manual says",
            )
        if unit == "dB":
            features.set_number((name,), gain_db, floor=_GAIN_FLOOR_DB)
        else:
            factor = 10 ** (gain_db / 20)
            features.set_number((name,), factor, floor=factor * (10 ** (_GAIN_FLOOR_DB / 20) - 1))

    def gain_db(self) -> float | None:
        """The gain in decibels as read back; None where its unit is not known."""
        features = self._features
        name, raw = features.find(genicam.GAIN_DB), features.number(genicam.GAIN_RAW)
        if name is None:
            return None if raw is None or self._raw_per_db is None else raw / self._raw_per_db
        unit, value = self._unit_of_gain(name), features.number((name,))
        if value is None or unit is None or (unit == "factor" and value <= 0):
            return None
        return value if unit == "dB" else 20 * math.log10(value)

    def _unit_of_gain(self, name: str) -> Literal["dB", "factor"] | None:
        if name in genicam.GAIN_RAW:
            return None
        return self._gain_unit or gain_unit(self._features.unit(name))

    def _refused(self, gain_db: float, came_back: str) -> SettingRefused:
        return SettingRefused(
            f"camera {self._name}, gain_db {gain_db:g}", came_back, "Change the setting in the plan or the rig file"
        )

    # --- converter ---------------------------------------------------------------------------------------

    def set_converter(self, fmt: PixelFormat) -> None:
        """Set the converter to at least the bits of the format, where that can be chosen."""
        name = self._features.find(genicam.CONVERTER_BITS)
        if name is None:
            return
        if "Manual" in self._features.choices("BslSensorBitDepthMode"):
            self._features.set_choice("BslSensorBitDepthMode", "Manual")
        entry_of_bits = {bits: entry for entry in self._features.choices(name) if (bits := _bits_in(entry)) is not None}
        sufficient = [bits for bits in entry_of_bits if bits >= fmt.bits]
        if not entry_of_bits or (self.converter_bits() or 0) >= fmt.bits:
            return
        # After a refusal the value read back gives the end of the counts.
        with ignore_refusals():
            self._features.set_value(name, entry_of_bits[min(sufficient) if sufficient else max(entry_of_bits)])

    def converter_bits(self) -> int | None:
        """Bits of the converter as the camera tells them; None where it does not."""
        name = self._features.find(genicam.CONVERTER_BITS)
        return None if name is None else _bits_in(self._features.text((name,)))


def _bits_in(entry: str) -> int | None:
    match = re.search(r"\d+", entry)
    return int(match.group()) if match is not None and 6 <= int(match.group()) <= 16 else None
