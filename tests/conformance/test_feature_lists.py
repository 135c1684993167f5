"""Public feature lists of cameras, every feature at a random legal value: right frames, or a refusal in words.

``FEATURE_LISTS=FOLDER ./lab test --all tests/conformance/test_feature_lists.py``: FOLDER holds the `.template` files of
the EPICS module ADGenICam (`GenICamApp/Db`), which are not part of this project; `FEATURE_SEED` chooses the values. A
list tells no limits and no defaults: those here are ours.
"""

import os
import re
import time
import zlib
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import CameraSettings
from drivers.errors import SettingRefused
from drivers.pixel_formats import PIXEL_FORMATS
from simulators.camera.exposure import ExposureInfo
from simulators.camera.genicam.node_tree import NodeError
from simulators.camera.image_settings import delay_s
from tests.conformance.described_camera import EMPTY, DescribedCamera

LISTS = [
    path
    for path in sorted(Path(os.environ.get("FEATURE_LISTS", "-")).glob("*.template"))
    if not path.name.startswith(("ADGenICam", "Euresys"))
]
SIZE = (64, 48)
EXPOSURE_S, GAIN_DB, RAW_PER_DB = 0.03, 6.0, 10
#: From the end of an exposure by the camera's clock to what the driver may take for it.
EARLY_S = 2e-3
FORMATS = {fmt.name: fmt for fmt in PIXEL_FORMATS}
#: Cameras that no trigger makes expose.
UNTRIGGERED = (
    *("Adimec_Q12A180CXP_1_1_5", "Basler_piA640_210gm", "FLIR_A35", "FLIR_SC6700", "Orca_Fire_C16240-20UP"),
    *("Teledyne_ShadoBox", "Tucsen_CXP_Dhyana6060BSI"),
)
CODES = {name: fmt.code for name, fmt in FORMATS.items() if fmt.code is not None}
RECORD = re.compile(r'record\((\w+),[^{]*"\)\s*\{(.*?)\n\}', re.DOTALL)
ORDINALS = re.compile(r'(?:ZR|ON|TW|TH|FR|FV|SX|SV|EI|NI|TE|EL|TV|TT|FT|FF)ST,\s*"([^"]+)"')
TRIGGERS = re.compile("Trigger(Mode|Source|Activation|Delay|DelayAbs|Software)")
#: What only the camera itself changes, whatever the list says.
OWN = re.compile("PayloadSize|Sensor(Width|Height)|(Width|Height)Max")
#: Limits by name; the first that fits.
LIMITS: tuple[tuple[str, float, float], ...] = (
    ("(Sensor)?Width(Max)?", 1, SIZE[0]),
    ("(Sensor)?Height(Max)?", 1, SIZE[1]),
    ("Offset[XY]", 0, 40),
    ("ExposureTime(Abs|Raw)?|ExposureValue", 20, 5e6),
    ("TriggerDelay(Abs)?|FrameStartTriggerDelay|TrigDelay", 0, 3e5),
    ("(Binning|Decimation)(Horizontal|Vertical)", 1, 4),
    ("AcquisitionFrameRate(Abs)?", 0.1, 500),
    ("Scaling(Horizontal|Vertical)Abs", 0.1, 1),
    ("Bsl(Contrast|Brightness)", -1, 1),
    ("Gamma", 0.25, 4),
    ("DigitalShift", 0, 4),
    ("GainRaw", 0, 240),
    ("BlackLevel", 0, 255),
    ("AcquisitionBurstFrameCount", 1, 100),
    ("GevSCPSPacketSize", 576, 9000),
    ("PayloadSize", 0, 1 << 30),
    (".*", 0, 1000),
)
TIME_CHUNK = (
    '<Port Name="TimeChunk"><ChunkID>4D000002</ChunkID></Port><Integer Name="ChunkTimestamp"><pValue>TimeAt</pValue>'
    '</Integer><IntReg Name="TimeAt"><Address>0</Address><Length>8</Length><AccessMode>RO</AccessMode><pPort>TimeChunk'
    "</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
)


def read_list(text: str) -> dict[str, tuple[str, bool, list[str]]]:
    """Letter of the type (I, D, E, B, S, C), whether it can be set, and entries, for each feature of a template."""
    features: dict[str, tuple[str, bool, list[str]]] = {}
    for record, body in RECORD.findall(text):
        if (named := re.search(r"GC_([EIDBSC])_(\w+)", body)) is None:
            continue
        letter, writable, entries = features.get(named[2], (named[1], False, []))
        writable |= record in ("ao", "bo", "mbbo", "longout", "stringout")
        ordinals = [re.sub(r"\W", "_", entry) for entry in ORDINALS.findall(body)]
        features[named[2]] = letter, writable and not OWN.fullmatch(named[2]), list(dict.fromkeys(ordinals)) or entries
    return features


class ListedCamera(DescribedCamera):
    """A camera with the features of a list; `infos` are its exposures."""

    def __init__(self, path: Path, folder: Path, stack: ExitStack, rng: np.random.Generator) -> None:
        super().__init__(folder, stack, EMPTY, SIZE, self._show)
        self.features = read_list(path.read_text(errors="replace"))
        self.features.setdefault("PayloadSize", ("I", False, []))
        self.rng, self.infos, self.bits = rng, list[ExposureInfo](), 12
        self._gain = ("dB", 0, 24) if rng.integers(2) else ("factor", 1, 16)
        for name, (letter, writable, entries) in self.features.items():
            self._describe(name, letter, "RW" if writable else "RO", entries)

    def _limits(self, name: str) -> tuple[float, float]:
        if name in ("Gain", "GainAbs"):
            return self._gain[1:]
        return next((low, high) for pattern, low, high in LIMITS if re.fullmatch(pattern, name))

    def _describe(self, name: str, letter: str, access: str, entries: list[str]) -> None:
        selected = TRIGGERS.fullmatch(name) and "TriggerSelector" in self.features
        index = '<pIndex Offset="8">TriggerSelectorAt</pIndex>' if selected else ""
        if name == "ChunkTimestamp":
            # It stands behind the image, not in a register.
            self.text = self.text.replace("</RegisterDescription>", f"{TIME_CHUNK}</RegisterDescription>")
        elif letter == "C":
            node = f'<Command Name="{name}">VALUE<CommandValue>1</CommandValue></Command>'
            self.add(name, node, index=index)
        elif letter == "E":
            unknown = {entry: 0x7000_0000 + k for k, entry in enumerate(entries)}
            codes = unknown | CODES if name == "PixelFormat" else {}
            self.choice(name, *entries, access=access, codes=codes, index=index)
        elif letter == "B":
            self.flag(name, access)
        elif letter == "S":
            self.add(name, f'<String Name="{name}">VALUE</String>', access, "StringReg", 64)
        else:
            low, high = self._limits(name)
            kind, register, length = ("Integer", "IntReg", 4) if letter == "I" else ("Float", "FloatReg", 8)
            low, high = (round(low), round(high)) if letter == "I" else (low, high)
            unit = "us" if re.match("ExposureT|TriggerD", name) else ""
            unit = self._gain[0] if name in ("Gain", "GainAbs") else unit
            unit_node = f"<Unit>{unit}</Unit>" if unit and kind == "Float" else ""
            node = f'<{kind} Name="{name}">VALUE<Min>{low}</Min><Max>{high}</Max>{unit_node}</{kind}>'
            self.add(name, node, access, register, length, index)

    def left_values(self) -> dict[str, float | int | str]:
        """A random legal value for every feature that can be set."""
        values: dict[str, float | int | str] = {}
        for name, (letter, writable, entries) in self.features.items():
            low, high = self._limits(name)
            if writable and letter == "E" and entries:
                values[name] = str(self.rng.choice(entries))
            elif writable and letter in "BI":
                values[name] = int(self.rng.integers(2) if letter == "B" else self.rng.integers(low, high + 1))
            elif writable and letter == "D":
                values[name] = self.rng.uniform(low, high)
        return values

    def _show(self, info: ExposureInfo) -> NDArray[np.uint16]:
        self.infos.append(info)
        return self.seen(info)

    def seen(self, info: ExposureInfo) -> NDArray[np.uint16]:
        """What the sensor shows in an exposure."""
        rng = np.random.default_rng(info.frame_id)
        return rng.integers(0, 1 << self.bits, (info.height, info.width)).astype(np.uint16)


@pytest.mark.long
@pytest.mark.skipif(not LISTS, reason="FEATURE_LISTS names no folder with .template files")
@pytest.mark.parametrize("path", LISTS, ids=[path.stem for path in LISTS])
def test_frames_are_right_or_the_camera_is_refused_in_words(path: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng([int(os.environ.get("FEATURE_SEED", "1")), zlib.crc32(path.stem.encode())])
    with ExitStack() as stack:
        listed = ListedCamera(path, tmp_path, stack, rng)
        formats = [FORMATS[entry] for entry in listed.features["PixelFormat"][2] if entry in FORMATS]
        fmt = formats[int(rng.integers(len(formats)))]
        listed.bits = fmt.bits
        camera = listed.play(bits=fmt.bits)
        for name, value in listed.left_values().items():
            try:
                camera.leave(name, value)
            except NodeError:
                # A limit that depends on another feature.
                continue
        if rng.integers(2):
            # A camera whose default is what somebody left.
            camera.default = camera.memory.copy()
        driver = listed.open(gain_raw_per_db=RAW_PER_DB)
        gains = [name for name in ("Gain", "GainAbs", "GainRaw") if name in listed.features]
        gain_db = GAIN_DB if gains else None
        settings = CameraSettings(exposure_s=EXPOSURE_S, gain_db=gain_db, pixel_format=fmt.name)
        if path.stem in UNTRIGGERED:
            with pytest.raises(SettingRefused, match=r"it has no TriggerMode|its TriggerSelector offers only"):
                driver.configure(settings)
            return
        driver.configure(settings)
        for _ in range(3):
            exposure = driver.trigger()
            exposure.wait_exposed()
            moved_s = time.monotonic()
            frame, info = exposure.frame(), listed.infos[-1]
            assert info.exposure_s == pytest.approx(EXPOSURE_S, rel=1e-3)
            # On a busy machine the played camera begins later than its trigger comes.
            began_s = camera.triggered_s + delay_s(camera.features)
            assert moved_s >= began_s + info.exposure_s - EARLY_S
            if gain_db is not None:
                per_db = RAW_PER_DB if gains == ["GainRaw"] else 1
                assert info.gain_db / per_db == pytest.approx(gain_db, abs=0.06)
            step = driver.top_of_counts.step
            assert driver.full_scale % step == 0
            np.testing.assert_array_equal(frame.pixels, listed.seen(info) // step * step)
