"""Settings that another program may have left on a camera, and the value at which each of them does nothing.

A GenICam description does not tell what a setting does or where it is neutral. The rules here go by the names of the
GenICam Standard Features Naming Convention (SFNC 2.7) and by those that makers have in public feature lists (84 lists
of the EPICS ADGenICam module: Allied Vision, Basler, FLIR, Point Grey, Adimec, Mikrotron, Teledyne, Tucsen, ViewWorks).
A rule is a pattern, so it also matches similar names that are not in those lists.
"""

import math
import re
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Literal

from drivers.errors import CameraError, CameraLost, SettingRefused, ignore_refusals
from drivers.genicam import EXPOSURE_US, Features

# What makers call an enumeration's entry that switches something off.
_OFF_WORDS = ("Off", "None", "Disable", "False", "No", "Normal", "Standard", "Linear", "LiveVideo", "Manual")
_OFF_ENDS = ("off", "none", "disabled", "notest", "nopattern")
# Some cameras go on loading after they have answered.
_LOAD_S = 2.0
_DEFAULT_SETS = ("Default", "Factory", "Standard", "FactoryDefault", "Default0", "DefaultSet")
_LOADS = (
    ("UserSetSelector", "UserSetLoad"),
    ("ConfigFileIndex", "ConfigFileLoad"),
    ("UserSetSelectorReg", "UserSetLoadReg"),
)
# Selectors of features whose description need not say so.
_SELECTED_BY = {
    "TriggerDelay": "TriggerSelector",
    "TestPattern": "TestPatternGeneratorSelector",
    "LUTEnable": "LUTSelector",
    "BalanceRatio": "BalanceRatioSelector",
    "CorrectionMode": "CorrectionSelector",
    "ROIZoneMode": "ROIZoneSelector",
    "RegionMode": "RegionSelector",
}

Neutral = Literal["off", "least", "one", "unity"] | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Rule:
    """Features of a kind.

    Attributes
    ----------
    names : regular expression for the whole name without underscores, in any case of its letters.
    neutral : {"off", "least", "one", "unity"} or tuple of str
        Off: false, an entry that means off, or zero; least: the lower limit; one: a count of 1; unity: a factor of 1,
        which is not known where it is a whole number of other parts; else the entries that will do.
    harm : True where the counts or the time of the exposure are wrong as long as it is set: no capture is taken then,
        also where its neutral value is not known.
    """

    names: str
    neutral: Neutral
    harm: bool


#: From a trigger to the start of its exposure.
DELAYS = Rule(r"(\w*Trigger|Trig|Exposure(Start)?)Delay(Abs|Raw|Time)?", "least", True)

RULES = (
    # The image is not that of the sensor, or holds more than it.
    Rule(r"\w*Test(Pattern|Image|Mode)(Selector|Enable|Mode)?", "off", True),
    Rule(r"\w*(ImageGenerator|VideoSource)(Selector|Enable)?", ("Off", "Sensor", "LiveVideo", "Normal"), True),
    Rule(r"\w*(Overlay|Crosshair|ImageStamp|FrameStamp|Watermark|InfoField\w+)(Enable|Enabled|Mode)?", "off", True),
    Rule(r"(Horizontal|Vertical|Image|X|Y)?Flip([XY]|Mode)?|BsliAtpEnab|Multishot(Enable|Mode)", "off", True),
    Rule(r"GevSCPSBigEndian|\w*PixelBigEndian|ImageCompressionMode|\w*LossyCompression\w*Enable", "off", True),
    # Settings change from frame to frame.
    Rule(
        r"\w*(Exposure|Gain|BlackLevel|White|WhiteBalance|Brightness|Contrast|Gamma|ExposureCompensation|BalanceRatio)Auto"
        r"(Enable|Enabled)?|Auto(Exposure|Gain|BlackLevel|White(Balance)?|Brightness|Contrast)(Mode|Enable|Enabled)?",
        "off",
        True,
    ),
    Rule(r"(Sequencer|Sequence|Bsl\w*Sequencer)(Configuration)?(Mode|Enable|Enabled)", "off", True),
    Rule(r"\w*(HDR|WDR|MultiExposure|MultiSlope|PieceWise\w*)(Mode|ModeEnabled?|Enabled?)?", "off", True),
    Rule(r"\w*(Hue|Saturation|Sharpness|Sharpening|FrameRate|Iris|Focus|Defog|Flicker\w*)Auto", "off", False),
    # The exposure does not begin with its trigger.
    Rule(r"(\w*Trigger|Exposure(Start)?)Delay(Enable|Enabled)", "off", True),
    DELAYS,
    Rule(r"TriggerOverlap", "off", False),
    Rule(r"Trigger(Divider|Multiplier)|AcquisitionBurstFrameCount", "one", True),
    Rule(
        r"EnableBurstAcquisition|BurstModeEnable|PtpAcquisitionGateTime|StreamHoldEnable|TriggerCacheEnable",
        "off",
        True,
    ),
    Rule(r"TransferControlMode", ("Automatic", "Basic"), True),
    Rule(r"\w*(Averag(e|ing)\w*(Number|Count|Frames)\w*|FrameAverag\w*|FrameIntegration\w*Count)", "one", True),
    Rule(r"\w*(Averag(e|ing)|FrameIntegration)(Mode|Enable)", "off", True),
    # Counts are not linear in light, or not in the unit of the converter.
    Rule(r"\w*(Gamma|LUT|Contrast|ToneMapping|Dehaze|Defog)(Enable|Enabled|CorrectionEnable)|LUTMode", "off", True),
    Rule(r"Gamma(Abs)?", "unity", True),
    Rule(r"\w*ContrastMode", "off", True),
    Rule(r"Bsl(Brightness|Contrast)(Raw)?|BlackLevelOffsetDigital", "off", True),
    Rule(r"DigitalShift", "off", True),
    Rule(r"\w*DigitalGain\w*", "unity", False),
    # A pixel holds the light of its neighbours, which are other analyzers on a mosaic.
    Rule(r"\w*(Sharpen(ing)?|Denois(e|ing)|MedianFilter)(Enable|Enabled|Mode)?", "off", True),
    Rule(r"\w*(Sharpness|(?<!Pattern)NoiseReduction)(Enable|Enabled|Mode)", "off", True),
    Rule(
        r"\w*(EdgeFilter|EdgeEnhancement|Convolution|SmoothFilter|AdaptiveNoiseSuppression)(Mode|Enable)?", "off", True
    ),
    Rule(r"NirMode|DemosaicingMode|PgiMode|ProcessedRawEnable|OnBoardColorProcessEnabled", "off", False),
    Rule(
        r"\w*Defect\w*(Correct\w*|Mask)(Static|Dynamic|Row|Column|Pixel)?(Mode|Enable|Enabled)|DefectMask\w*Enable",
        "off",
        False,
    ),
    Rule(r"VendorDefectPixelCorr|BsliDPC[EH]|(HotPixel|\w*Defective\w*|FlatField)Correction", "off", False),
    # A factor for each pixel or colour, the same for every frame.
    Rule(
        r"\w*(FFC|FlatField|FlatFieldCorrection|Shading|LensShading|Vignetting)(Correction)?(Mode|Enable)", "off", False
    ),
    Rule(r"BalanceRatio(Abs)?", "unity", False),
    Rule(r"LightSource(Selector|Preset)", "off", False),
    Rule(r"\w*(ColorTransformation|ColorAdjustment|ColorCorrection|Saturation|Hue)(Mode|Enable|Enabled)", "off", False),
    # Which pixels are read.
    Rule(
        r"Center[XY]|\w*Multi(ple)?(ROI|Region)\w*Enable|StackedZoneImaging\w*Enable|(ROIZone|Region)Mode", "off", True
    ),
    Rule(r"LegacyBinning(Horizontal|Vertical)|\w*(Interlac|Binning)\w*Enable", "off", True),
    Rule(r"Scaling(Horizontal|Vertical)(Abs)?", "unity", True),
    Rule(r"DeviceScanType", ("Areascan",), True),
    # The clock of the exposure.
    Rule(r"ExposureTimeMode|ExposureTimeSelector", ("Standard", "Common", "Timed"), True),
    Rule(r"ShortExposureEnable|ExposureTimeBaseAbsEnable|GlobalResetReleaseModeEnable", "off", True),
)
_COMPILED = tuple((re.compile(rule.names, re.IGNORECASE), rule) for rule in RULES)

# Writable features that say nothing of counts or times of frames: the link, lines that go out, what a program reads.
_NO_MATTER = re.compile(
    r"(Gev|Event|Chunk|File|User|Device|Line|Sync|Strobe|Counter|Timer|Action|Serial|Pt[pP]|Timestamp|Test|Expert|Payload"
    r"|Auto|Lens|PIris|Iris|EFLens|U3V|TL|Bandwidth|Logic|Transfer|IEEE|Firmware|Software|Bsl(Light|Ptp|Periodic|Line)"
    r"|Exposure(Auto|Time)|Gain(Auto|Raw|Abs)?$|Balance|Color|LUT|Defect|Sequence|Stream|Link|Cxp|Connection|DSP|PLC_"
    r"|(Binning|Decimation|Reverse|Trigger|Acquisition|Width|Height|Offset[XY]|PixelFormat|BlackLevel)"
    r")|\w*(Selector|SelectorIndex|Status|Reset|AccessKey)$"
)


def rule_for(name: str) -> Rule | None:
    """The first rule whose pattern is that of a feature's name; None for a name that no rule knows."""
    return next((rule for pattern, rule in _COMPILED if pattern.fullmatch(name.replace("_", ""))), None)


def _text(value: str | float | bool) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _entry(words: Collection[str], entries: list[str]) -> str | None:
    """The entry that is the first of the words in any case of its letters, or ends like one that means off."""
    by_plain = {entry.replace("_", "").lower(): entry for entry in entries}
    exact = next((by_plain[word.lower()] for word in words if word.lower() in by_plain), None)
    ends = _OFF_ENDS if "Off" in words else ()
    return exact or next((entry for plain, entry in by_plain.items() if plain.endswith(ends)), None)


class NeutralFeatures:
    """Brings one camera to a known state: its own default first, then every feature that a rule knows.

    Parameters
    ----------
    name : name of the camera in messages.
    features : those of the open camera; its acquisition is stopped.
    user_set : the set that is loaded first; None loads none.
    exempt : collection of str
        Features of the rig file: they are set on purpose, so no rule is applied to them.

    Attributes
    ----------
    remarks : what could not be set, in words, for `acquire doctor` and the capture file.
    """

    def __init__(self, name: str, features: Features, user_set: str | None, exempt: Collection[str]) -> None:
        self._name, self._features, self._user_set, self._exempt = name, features, user_set, frozenset(exempt)
        self._is_loaded = False
        self._rules: list[tuple[str, Rule]] | None = None
        self.remarks: list[str] = []

    def establish(self) -> None:
        """Load the default once, and set every feature that a rule knows.

        Raises CameraLost: the camera stopped answering.
        """
        if self._rules is None:
            names = self._features.names()
            rules = ((name, rule_for(name)) for name in names)
            self._rules = [(name, rule) for name, rule in rules if rule is not None and name not in self._exempt]
        if not self._is_loaded:
            self.remarks = list(self._load())
            self._is_loaded = True
        self._set_all()

    def _set_all(self) -> None:
        for name, rule in self._rules or ():
            for _ in self._entries_of_selector(name):
                self._set(name, rule)

    def require(self) -> None:
        """Read every feature once more, after all settings are made.

        Raises SettingRefused: one that spoils the frames is not neutral.
        """
        issues = list(self._not_neutral())
        if issues:
            # Some can only be set now that others are.
            self._set_all()
            issues = list(self._not_neutral())
        if harmful := [text for text, rule in issues if rule.harm]:
            raise SettingRefused(
                f"camera {self._name}, bring it to a known state",
                "; ".join(harmful),
                "Set it in the maker's program, or write it under `features` of the camera in the rig file if the "
                "frames are right with it",
            )
        reported = set(self.remarks)
        self.remarks += [text for text, _ in issues if text not in reported]

    def _load(self) -> Iterator[str]:
        """Load the default user set; yields a remark on features that stay unknown."""
        if self._user_set is None:
            yield from self._remark_unknown("no user set is loaded (`user_set: null`)")
            return
        features = self._features
        if features.find(("DefaultSetSelector",)) is not None and "Standard" in features.choices("DefaultSetSelector"):
            self._try("DefaultSetSelector", "Standard")
        for selector, load in _LOADS:
            if features.find((selector,)) is None or features.find((load,)) is None:
                continue
            preset = next((key for key in (self._user_set, *_DEFAULT_SETS) if key in features.choices(selector)), None)
            if preset is None:
                break
            probe = self._probe()
            try:
                features.set_choice(selector, preset)
                features.command(load)
            except CameraLost:
                raise
            except CameraError as error:
                yield from self._remark_unknown(f"the default settings were not loaded ({error.came_back})")
                return
            if probe is not None and not self._is_over(*probe):
                yield from self._remark_unknown(f"{load} of {preset} changed nothing, {probe[0]} stayed as it was")
            return
        yield from self._remark_unknown("this camera has no default settings to load")

    def _probe(self) -> tuple[str, float] | None:
        """Set the exposure to a value that no default has, so that a load that does nothing is seen."""
        name = self._features.find(EXPOSURE_US)
        self._try("ExposureAuto", "Off")
        now = None if name is None else self._value(name)
        if name is None or not isinstance(now, float):
            return None
        for trial_us in (1.37 * now, 0.73 * now):
            if self._try(name, float(round(trial_us))) and isinstance(echo := self._value(name), float) and echo != now:
                return name, echo
        return None

    def _is_over(self, name: str, before: float) -> bool:
        """Wait until a load has changed the probe; False if it does not."""
        end_s = time.monotonic() + _LOAD_S
        while self._value(name) in (None, before):
            if time.monotonic() > end_s:
                return False
            time.sleep(0.01)
        return True

    def _remark_unknown(self, why: str) -> Iterator[str]:
        names = [
            name
            for name in self._features.writable()
            if rule_for(name) is None and name not in self._exempt and not _NO_MATTER.match(name)
        ]
        if names:
            yield f"{why}: {', '.join(names)} may be as another program set them"

    def _entries_of_selector(self, name: str) -> Iterator[None]:
        """Choose each entry of a feature's selector in turn; once without one."""
        features = self._features
        selector = features.selector_of(name) or next(
            (feature for start, feature in _SELECTED_BY.items() if re.fullmatch(start + "(Abs|Raw)?", name)), None
        )
        entries = features.choices(selector) if selector is not None else []
        if selector is None or not entries:
            yield
            return
        selected = features.text((selector,))
        for entry in entries:
            # The first region is the image.
            if (name, entry) != ("RegionMode", "Region0") and self._try(selector, entry):
                yield
        self._try(selector, selected)

    def _try(self, name: str, value: str | float | bool) -> bool:
        """Set a feature; False where the camera does not take it."""
        with ignore_refusals():
            self._features.set_value(name, value)
            return True
        return False

    def _set(self, name: str, rule: Rule) -> None:
        if self._features.find((name,)) is None:
            return
        neutral = self._neutral_value(name, rule)
        if neutral is not None and self._value(name) != neutral:
            self._try(name, neutral)

    def _value(self, name: str) -> str | float | bool | None:
        with ignore_refusals():
            return self._features.value(name)
        return None

    def _neutral_value(self, name: str, rule: Rule) -> str | float | bool | None:
        """The value to be set; None where no value of this feature is known to be neutral."""
        kind = self._features.kind(name)
        if kind == "flag":
            return False
        if kind == "choice":
            words = _OFF_WORDS if isinstance(rule.neutral, str) else rule.neutral
            if rule.neutral in ("one", "unity"):
                words = ("One", "OneX", "X1", "1x", "1", *_OFF_WORDS)
            return _entry(words, self._features.choices(name))
        unknown = rule.neutral == "unity" and not self._features.is_float(name)
        if kind != "number" or not isinstance(rule.neutral, str) or unknown:
            return None
        with ignore_refusals():
            low, high = self._features.limits(name)
            neutral = {"off": 0.0, "least": low}.get(rule.neutral, 1.0)
            return neutral if low <= neutral <= high else None
        return None

    def _not_neutral(self) -> Iterator[tuple[str, Rule]]:
        for name, rule in self._rules or ():
            for _ in self._entries_of_selector(name):
                if self._features.find((name,)) is None:
                    continue
                neutral, now = self._neutral_value(name, rule), self._value(name)
                if now is None or now == neutral or self._is_switched_off(name):
                    continue
                if neutral is None:
                    if rule.harm:
                        yield f"{name} is {_text(now)}, and which of its values does nothing is not known", rule
                    continue
                numbers = isinstance(now, float) and isinstance(neutral, float)
                if not (numbers and math.isclose(float(now), float(neutral), rel_tol=1e-3, abs_tol=1e-3)):
                    yield f"{name} is {_text(now)} and could not be set to {_text(neutral)}", rule

    def _is_switched_off(self, name: str) -> bool:
        """True where a flag says that a number or a mode is not used."""
        stems = {name, name.removesuffix("Mode")}
        return any(self._value(stem + end) in (False, "Off") for stem in stems for end in ("Enable", "Enabled"))
