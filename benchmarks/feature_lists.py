"""Captures from cameras with the features of public lists, each feature at a random legal value before.

``python benchmarks/feature_lists.py FOLDER [SEED]``: FOLDER holds the `.template` files of the EPICS module ADGenICam
(`GenICamApp/Db`), which are not part of this project. Each becomes a description that the played camera serves. A list
is right where frames, exposure, gain and the time of the exposure are those that were asked for, and refused where the
driver says in words why not. Anything else is wrong. A list tells no limits and no default: those here are ours.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from drivers.errors import DeviceError
from drivers.pixel_formats import PIXEL_FORMATS, PixelFormat
from simulators.camera.exposure import ExposureInfo
from simulators.camera.played.image_settings import delay_s
from simulators.camera.played.node_tree import NodeError
from simulators.camera.played.played_camera import PlayedCamera
from simulators.clock import patient_clock

SIZE = (64, 48)
EXPOSURE_S, GAIN_DB = 0.03, 6.0
#: From the end of an exposure by the camera's clock to what the driver may take for it.
EARLY_S = 2e-3
FORMATS = {fmt.name: fmt for fmt in PIXEL_FORMATS}
SYSTEM = ("ADGenICam", "Euresys")
ORDINALS = ("ZR", "ON", "TW", "TH", "FR", "FV", "SX", "SV", "EI", "NI", "TE", "EL", "TV", "TT", "FT", "FF")
TRIGGERS = ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerDelay", "TriggerDelayAbs", "TriggerSoftware")
LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw", "ExposureValue"), (20, 5_000_000)),
    **dict.fromkeys(("TriggerDelay", "TriggerDelayAbs", "FrameStartTriggerDelay", "TrigDelay"), (0, 300_000)),
    **dict.fromkeys(("BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical"), (1, 4)),
    **dict.fromkeys(("AcquisitionFrameRate", "AcquisitionFrameRateAbs"), (0.1, 500)),
    **dict.fromkeys(("ScalingHorizontalAbs", "ScalingVerticalAbs"), (0.1, 1)),
    **dict.fromkeys(("BslContrast", "BslBrightness"), (-1, 1)),
    "Gamma": (0.25, 4),
    "DigitalShift": (0, 4),
    "GainRaw": (0, 240),
    "BlackLevel": (0, 255),
    "AcquisitionBurstFrameCount": (1, 100),
    "GevSCPSPacketSize": (576, 9000),
    "PayloadSize": (0, 1 << 30),
}


#: What only the camera itself changes, whatever the list says.
OWN = ("PayloadSize", "SensorWidth", "SensorHeight", "WidthMax", "HeightMax")


@dataclass
class Feature:
    """One feature of a list: letter of its type (I, D, E, B, S, C), if it can be set, entries of an enumeration."""

    letter: str
    writable: bool = False
    entries: list[str] = field(default_factory=list)


def read_list(text: str) -> dict[str, Feature]:
    """Features of an EPICS template by name."""
    found: dict[str, Feature] = {}
    for record, body in re.findall(r'record\((\w+),[^{]*"\)\s*\{(.*?)\n\}', text, re.DOTALL):
        told = re.search(r"GC_([EIDBSC])_(\w+)", body)
        if told is None:
            continue
        feature = found.setdefault(told[2], Feature(told[1]))
        feature.writable |= record in ("ao", "bo", "mbbo", "longout", "stringout")
        entries = [re.search(rf'{ordinal}ST,\s*"([^"]+)"', body) for ordinal in ORDINALS]
        feature.entries = [entry[1] for entry in entries if entry is not None] or feature.entries
    return found


class Description:
    """The GenICam description of a list."""

    def __init__(self, features: dict[str, Feature], rng: np.random.Generator) -> None:
        self.features = features
        self._gain_unit = str(rng.choice(["dB", "factor"]))
        self._next = 0x10_0000
        self._nodes: list[str] = []
        for name, feature in features.items():
            self._nodes.append(self._node(name, feature))

    def text(self) -> str:
        names = "".join(f"<pFeature>{name}</pFeature>" for name in self.features)
        return (
            '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="List" VendorName="Public" '
            'StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
            'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0" '
            f'xmlns="http://www.genicam.org/GenApi/Version_1_1"><Category Name="Root">{names}</Category>'
            f'<Port Name="Device"/>{"".join(self._nodes)}</RegisterDescription>'
        )

    def limits(self, name: str) -> tuple[float, float]:
        """Lowest and highest value of a number."""
        if name in ("Gain", "GainAbs"):
            return (0, 24) if self._gain_unit == "dB" else (1, 16)
        return LIMITS.get(name, (0, 1000))

    def _register(self, name: str, kind: str, length: int, access: str) -> str:
        self._next += 0x100
        selected = name in TRIGGERS and "TriggerSelector" in self.features
        index = '<pIndex Offset="8">TriggerSelector__at</pIndex>' if selected else ""
        sign = "<Sign>Unsigned</Sign>" if kind == "IntReg" else ""
        order = "" if kind == "StringReg" else "<Endianess>BigEndian</Endianess>"
        return (
            f'<{kind} Name="{name}__at"><Address>{self._next:#x}</Address>{index}<Length>{length}</Length>'
            f"<AccessMode>{access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>{sign}{order}</{kind}>"
        )

    def _node(self, name: str, feature: Feature) -> str:
        access = "RW" if feature.writable else "RO"
        behind = f"<pValue>{name}__at</pValue>"
        if feature.letter == "C":
            command = f'<Command Name="{name}">{behind}<CommandValue>1</CommandValue></Command>'
            return command + self._register(name, "IntReg", 4, "RW")
        if feature.letter == "E":
            entries = "".join(
                f'<EnumEntry Name="{entry}"><Value>{self._code(name, entry, k)}</Value></EnumEntry>'
                for k, entry in enumerate(dict.fromkeys(re.sub(r"\W", "_", entry) for entry in feature.entries))
            )
            chosen = f'<Enumeration Name="{name}">{entries}{behind}</Enumeration>'
            return chosen + self._register(name, "IntReg", 4, access)
        if feature.letter == "B":
            flag = f'<Boolean Name="{name}">{behind}<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>'
            return flag + self._register(name, "IntReg", 4, access)
        if feature.letter == "S":
            return f'<String Name="{name}">{behind}</String>' + self._register(name, "StringReg", 64, access)
        return self._number(name, feature, access)

    def _number(self, name: str, feature: Feature, access: str) -> str:
        kind, register, length = ("Integer", "IntReg", 4) if feature.letter == "I" else ("Float", "FloatReg", 8)
        low, high = self.limits(name)
        most = f"<Max>{high:g}</Max>" if kind == "Float" else f"<Max>{high:.0f}</Max>"
        least = f"<Min>{low:g}</Min>" if kind == "Float" else f"<Min>{low:.0f}</Min>"
        unit = {"ExposureTime": "us", "ExposureTimeAbs": "us", "TriggerDelay": "us", "TriggerDelayAbs": "us"}.get(
            name, ""
        )
        if name in ("Gain", "GainAbs"):
            unit = self._gain_unit
        size = {"Width": SIZE[0], "Height": SIZE[1]}.get(name.removeprefix("Sensor").removesuffix("Max"))
        if size is not None:
            most, least = f"<Max>{size}</Max>", "<Min>1</Min>"
        if name in ("OffsetX", "OffsetY"):
            most = "<Max>40</Max>"
        if name in OWN:
            access = "RO"
        told = f"<Unit>{unit}</Unit>" if unit and kind == "Float" else ""
        if name == "ChunkTimestamp":
            # It stands behind the image, not in a register.
            return (
                '<Port Name="TimeChunk"><ChunkID>4D000002</ChunkID></Port><Integer Name="ChunkTimestamp"><pValue>TimeAt'
                '</pValue></Integer><IntReg Name="TimeAt"><Address>0</Address><Length>8</Length><AccessMode>RO'
                "</AccessMode><pPort>TimeChunk</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
            )
        number = f'<{kind} Name="{name}"><pValue>{name}__at</pValue>{least}{most}{told}</{kind}>'
        return number + self._register(name, register, length, access)

    @staticmethod
    def _code(name: str, entry: str, position: int) -> int:
        if name != "PixelFormat":
            return position
        fmt = FORMATS.get(entry)
        return position + 0x7000_0000 if fmt is None or fmt.code is None else fmt.code


@dataclass
class Source:
    """What the sensor sees, and when it was asked."""

    bits: int = 12
    infos: list[ExposureInfo] = field(default_factory=list)

    def __call__(self, info: ExposureInfo) -> NDArray[np.uint16]:
        self.infos.append(info)
        return self.seen(info)

    def seen(self, info: ExposureInfo) -> NDArray[np.uint16]:
        rng = np.random.default_rng(info.frame_id)
        return rng.integers(0, 1 << self.bits, (info.height, info.width)).astype(np.uint16)


def leave_at_random(camera: PlayedCamera, description: Description, rng: np.random.Generator) -> None:
    """Every feature that can be set stands at a legal value afterwards."""
    for name, feature in description.features.items():
        if not feature.writable or name in OWN:
            continue
        try:
            if feature.letter == "E":
                camera.leave(name, re.sub(r"\W", "_", str(rng.choice(feature.entries))))
            elif feature.letter == "B":
                camera.leave(name, int(rng.integers(2)))
            elif feature.letter in "ID":
                low, high = description.limits(name)
                size = {"Width": SIZE[0], "Height": SIZE[1], "OffsetX": 40, "OffsetY": 40}.get(name)
                low, high = (1, size) if size is not None else (low, high)
                camera.leave(
                    name, int(rng.integers(low, high + 1)) if feature.letter == "I" else rng.uniform(low, high)
                )
        except (NodeError, KeyError):
            continue


def judge(name: str, features: dict[str, Feature], rng: np.random.Generator, path: Path) -> tuple[str, str]:
    """Right, refused or wrong, and in words why."""
    features.setdefault("PayloadSize", Feature("I"))
    description = Description(features, rng)
    path.write_text(description.text())
    source = Source()
    known: list[PixelFormat] = (
        [FORMATS[e] for e in features["PixelFormat"].entries if e in FORMATS] if ("PixelFormat" in features) else []
    )
    if not known:
        return "refused", "by the list: no pixel format that holds counts"
    fmt = known[int(rng.integers(len(known)))]
    source.bits = fmt.bits
    with PlayedCamera("LIST-1", *SIZE, source, path, bits=fmt.bits, complete=False) as camera:
        leave_at_random(camera, description, rng)
        loads = bool(rng.integers(2))
        if not loads:
            # A camera whose default is what somebody left.
            camera._default = camera._memory.copy()
        try:
            with aravis.open(
                "camera", aravis.Config(device=camera.address, gain_raw_per_db=10), patient_clock()
            ) as driver:
                return _capture(driver, camera, source, fmt, features)
        except DeviceError as error:
            return "refused", error.came_back
        finally:
            camera._error = None


def _capture(
    driver: aravis.AravisCamera, camera: PlayedCamera, source: Source, fmt: PixelFormat, features: dict[str, Feature]
) -> tuple[str, str]:
    gain_db = GAIN_DB if {"Gain", "GainAbs", "GainRaw"} & features.keys() else None
    driver.configure(CameraSettings(exposure_s=EXPOSURE_S, gain_db=gain_db, pixel_format=fmt.name))
    for _ in range(3):
        exposure = driver.trigger()
        exposure.wait_exposed()
        moved_s = time.monotonic()
        frame = exposure.frame()
        info = source.infos[-1]
        # As a camera that begins at once: on a busy machine the played one begins later than its trigger comes.
        began_s = camera.triggered_s + delay_s(camera._features)
        if info.exposure_s < EXPOSURE_S * 0.999 or info.exposure_s > EXPOSURE_S * 1.001:
            return "wrong", f"exposed {info.exposure_s:g} s"
        if moved_s < began_s + info.exposure_s - EARLY_S:
            return (
                "wrong",
                f"the bench moved {began_s + info.exposure_s - moved_s:.3f} s before the end of the exposure",
            )
        raw = "Gain" not in features and "GainAbs" not in features
        if gain_db is not None and abs(info.gain_db / (10 if raw else 1) - gain_db) > 0.06:
            return "wrong", f"gain {info.gain_db:g}"
        if not np.array_equal(frame.pixels, source.seen(info)) and not _is_quantized(
            frame.pixels, source.seen(info), driver
        ):
            seen = source.seen(info)
            return "wrong", f"other counts: {frame.pixels[0, :4]} for {seen[0, :4]}, step {driver.top_of_counts.step}"
    return "right", "; ".join(driver.warnings())


def _is_quantized(pixels: NDArray[np.uint16], seen: NDArray[np.uint16], driver: aravis.AravisCamera) -> bool:
    """True where the counts are those of a converter of fewer bits, and the driver knows its step."""
    step = driver.top_of_counts.step
    return step > 1 and np.array_equal(pixels, seen // step * step) and driver.full_scale % step == 0


def main(folder: Path, seed: int) -> None:
    """Judge every list of a folder."""
    counted: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as place:
        for path in sorted(folder.glob("*.template")):
            if path.name.startswith(SYSTEM):
                continue
            rng = np.random.default_rng([seed, zlib.crc32(path.stem.encode())])
            verdict, why = judge(path.stem, read_list(path.read_text(errors="replace")), rng, Path(place) / "list.xml")
            counted[verdict] += 1
            print(f"{path.stem:34} {verdict:8} {why[:150]}", flush=True)
    print(f"seed {seed}: " + ", ".join(f"{count} {verdict}" for verdict, count in sorted(counted.items())))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
