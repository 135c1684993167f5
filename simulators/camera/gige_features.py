"""The GenICam description of a camera with the features of a table; the registers behind them are ours."""

import functools
import re
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

from drivers.pixel_formats import pixel_format
from simulators.camera.genicam.description_file import Description, is_description, read_description, read_tree
from simulators.camera.genicam.formula import Number
from simulators.camera.node_map import NodeMap, node_map

SENSOR_HEIGHT, SENSOR_WIDTH = 0x118, 0x11C
WIDTH, HEIGHT, BINNING_X, BINNING_Y = 0x100, 0x104, 0x108, 0x10C
EXPOSURE_US, PIXEL_FORMAT, OFFSET_X, OFFSET_Y = 0x120, 0x128, 0x130, 0x134
# 64-bit big-endian floats.
GAIN_DB, BLACK_LEVEL, TEMPERATURE_C, GAMMA = 0x4000, 0x4008, 0x4010, 0x4018
GAIN_AUTO, GAMMA_ENABLE = 0x4020, 0x4024
REVERSE_X, REVERSE_Y, DECIMATION_X, DECIMATION_Y = 0x4028, 0x402C, 0x4030, 0x4034
SOFTWARE_TRIGGER, TRIGGER_ARMED = 0x30C, 0x4038
GAIN_RAW, BLACK_LEVEL_RAW, FRAME_RATE_ENABLE, PTP_ENABLE, PTP_STATUS = 0x4040, 0x4044, 0x4048, 0x404C, 0x4050
PACKET_DELAY = 0x4054
CHUNK_MODE, CHUNK_TIMESTAMP_ENABLE = 0x4058, 0x405C
# One for each status of the table.
STATUS = 0x4060
# Behind the image: its number and length, and a time stamp of 8 bytes with the same.
CHUNK_BYTES = 8 + 8 + 8
TIMESTAMP_CHUNK = 0xFF5A0001
# Texts of the GigE Vision bootstrap registers, 32 bytes each.
VENDOR_NAME, MODEL_NAME = 0x48, 0x68

# Automatic modes and gamma are on at power-up, as they are on many cameras.
_AT_POWER_UP: dict[str, str | Number] = {
    "GainAuto": "Continuous",
    "GammaEnable": 1,
    "Gamma": 0.45,
    "AcquisitionFrameRateEnable": 1,
}


def _register(name: str, address: int, kind: str = "IntReg", access: str = "RW", *, index: str = "") -> str:
    length, sign = (8, "") if kind == "FloatReg" else (4, "<Sign>Unsigned</Sign>")
    if 0x300 <= address < SOFTWARE_TRIGGER:
        index = '<pIndex Offset="0x20">TriggerSelectorValue</pIndex>'
    return (
        f'<{kind} Name="{name}Register"><Address>{address:#x}</Address>{index}<Length>{length}</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>{sign}"
        f"<Endianess>BigEndian</Endianess></{kind}>"
    )


def _integer(name: str, address: int, low: int, high: int | str, *, access: str = "RW", step: int = 1) -> str:
    return _number(name, f"{name}Register", low, high, step=step) + _register(name, address, access=access)


def _number(name: str, register: str, low: int, high: int | str, *, step: int = 1) -> str:
    top = f"<Max>{high}</Max>" if isinstance(high, int) else f"<pMax>{high}</pMax>"
    return (
        f'<Integer Name="{name}" NameSpace="Standard"><pValue>{register}</pValue><Min>{low}</Min>{top}'
        f"<Inc>{step}</Inc></Integer>"
    )


def _float(name: str, address: int, low: float, high: float, *, access: str = "RW", unit: str = "") -> str:
    unit = f"<Unit>{unit}</Unit>" if unit else ""
    return (
        f'<Float Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue><Min>{low}</Min><Max>{high}</Max>'
        f"{unit}</Float>{_register(name, address, 'FloatReg', access)}"
    )


def _choice(name: str, address: int, entries: dict[str, int], index: str = "") -> str:
    items = "".join(
        f'<EnumEntry Name="{entry}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>'
        for entry, value in entries.items()
    )
    return (
        f'<Enumeration Name="{name}" NameSpace="Standard">{items}<pValue>{name}Register</pValue></Enumeration>'
        f"{_register(name, address, index=index)}"
    )


def _selector(name: str, entries: Sequence[str]) -> str:
    items = "".join(f'<EnumEntry Name="{e}"><Value>{i}</Value></EnumEntry>' for i, e in enumerate(entries))
    return (
        f'<Integer Name="{name}Value"><Value>0</Value></Integer><Enumeration Name="{name}">{items}'
        f"<pValue>{name}Value</pValue></Enumeration>"
    )


def _formula(name: str, formula: str, **variables: str) -> str:
    items = "".join(f'<pVariable Name="{short}">{feature}</pVariable>' for short, feature in variables.items())
    return f'<IntSwissKnife Name="{name}" NameSpace="Standard">{items}<Formula>{formula}</Formula></IntSwissKnife>'


def _flag(name: str, address: int, access: str = "RW", index: str = "") -> str:
    return (
        f'<Boolean Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue><OnValue>1</OnValue>'
        f"<OffValue>0</OffValue></Boolean>{_register(name, address, access=access, index=index)}"
    )


def _text(name: str, address: int, length: int, access: str = "RO") -> str:
    return (
        f'<StringReg Name="{name}" NameSpace="Standard"><Address>{address:#x}</Address><Length>{length}</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort></StringReg>"
    )


def _command(name: str, address: int, value: int) -> str:
    return (
        f'<Command Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue>'
        f"<CommandValue>{value}</CommandValue></Command>{_register(name, address, access='WO')}"
    )


def describe(name: str, size: tuple[int, int]) -> Description:
    """Description of a camera: a file of GenICam (.xml, .zip), or a table by its name or its file (.yaml).

    Parameters
    ----------
    size : width and height of the sensor in pixels, for a table.

    Raises
    ------
    ConfigError
        There is none, or it cannot be read.
    """
    if is_description(name):
        return read_description(Path(name))
    table = node_map(name)
    return _of_table(description(table, *size).encode(), Path(name), table.arming_s)


@functools.lru_cache(maxsize=16)
def _of_table(text: bytes, source: Path, arming_s: float) -> Description:
    return Description(text, "camera.xml", read_tree(source, text), source, arming_s, _AT_POWER_UP)


def description(table: NodeMap, width: int, height: int) -> str:
    """Write the GenICam XML of a camera with the features of a table and a sensor of the given size in pixels."""
    features = [
        *_identity(table),
        *_region(table, width, height),
        _choice("PixelFormat", PIXEL_FORMAT, table.codes()),
        *_acquisition(table),
        *_light(table),
        *_clock(table),
        *_chunks(table),
        _integer("GevSCPD", PACKET_DELAY, 0, 1_000_000),
        _payload_size(table),
    ]
    names = re.findall(r'<(?!EnumEntry)\w+ Name="(\w+)" NameSpace="Standard">', "".join(features))
    items = "".join(f"<pFeature>{name}</pFeature>" for name in names)
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<RegisterDescription'
        f" ModelName={quoteattr(table.model)} VendorName={quoteattr(table.vendor)}"
        ' StandardNameSpace="None" SchemaMajorVersion="1" SchemaMinorVersion="0" SchemaSubMinorVersion="1"'
        ' MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0"'
        ' xmlns="http://www.genicam.org/GenApi/Version_1_0">\n'
        f'<Category Name="Root" NameSpace="Standard">{items}</Category>\n'
        + "\n".join([*features, '<Port Name="Device"/>'])
        + "\n</RegisterDescription>\n"
    )


def _identity(table: NodeMap) -> list[str]:
    texts = [
        _text("DeviceVendorName", VENDOR_NAME, 32),
        _text("DeviceModelName", MODEL_NAME, 32),
        _text("DeviceVersion", 0x88, 32),
        _text("DeviceSerialNumber", 0xD8, 16),
        _text("DeviceUserID", 0xE8, 16, "RW"),
    ]
    return texts + ([_float(table.temperature, TEMPERATURE_C, -40.0, 100.0, access="RO")] if table.temperature else [])


def _region(table: NodeMap, width: int, height: int) -> list[str]:
    angles = any(pixel_format(name).angles for name in table.pixel_formats)
    features = [
        _integer("SensorWidth", SENSOR_WIDTH, 1, width, access="RO"),
        _integer("SensorHeight", SENSOR_HEIGHT, 1, height, access="RO"),
        _maximum("WidthMax", width, "X", angles=angles),
        _maximum("HeightMax", height, "Y", angles=angles),
        _formula("OffsetXMax", "M - W", M="WidthMax", W="Width"),
        _formula("OffsetYMax", "M - H", M="HeightMax", H="Height"),
        _register("BinningX", BINNING_X),
        _register("BinningY", BINNING_Y),
        _register("DecimationX", DECIMATION_X),
        _register("DecimationY", DECIMATION_Y),
    ]
    for name, address, largest in (("Width", WIDTH, "WidthMax"), ("Height", HEIGHT, "HeightMax")):
        features.append(_integer(name, address, table.step.get(name, 1), largest, step=table.step.get(name, 1)))
    for name, address in (("OffsetX", OFFSET_X), ("OffsetY", OFFSET_Y)):
        features.append(_integer(name, address, 0, f"{name}Max", step=table.step.get(name, 1)))
    for name, highest in (("Binning", table.binning), ("Decimation", table.decimation)):
        if highest > 1:
            for axis, short in (("Horizontal", "X"), ("Vertical", "Y")):
                features.append(_number(f"{name}{axis}", f"{name}{short}Register", 1, highest))
    if table.reverse:
        features += [_flag("ReverseX", REVERSE_X), _flag("ReverseY", REVERSE_Y)]
    return features


def _maximum(name: str, pixels: int, axis: str, *, angles: bool) -> str:
    factors = {"B": f"Binning{axis}Register", "D": f"Decimation{axis}Register"}
    if not angles:
        return _formula(name, f"{pixels} / (B * D)", **factors)
    # Four counts a pixel, which is a super-pixel of the sensor.
    factor = "((((F &gt;&gt; 16) &amp; 0xFF) &gt; 16) ? 2 : 1)"
    return _formula(name, f"{pixels} / (B * D * {factor})", **factors, F="PixelFormatRegister")


def _acquisition(table: NodeMap) -> list[str]:
    features = [
        _choice("AcquisitionMode", 0x12C, {"Continuous": 1, "SingleFrame": 2, "MultiFrame": 3}),
        _command("AcquisitionStart", 0x124, 1),
        '<Command Name="AcquisitionStop" NameSpace="Standard"><pValue>AcquisitionStartRegister</pValue>'
        "<CommandValue>0</CommandValue></Command>",
        _selector("TriggerSelector", ["FrameStart", "AcquisitionStart"]),
        _choice("TriggerMode", 0x300, {"Off": 0, "On": 1}),
        _choice("TriggerSource", 0x304, {"Line0": 0, "Software": 1}),
        _choice("TriggerActivation", 0x308, {"RisingEdge": 0, "FallingEdge": 1}),
        _command("TriggerSoftware", SOFTWARE_TRIGGER, 1),
    ]
    if "TriggerArmed" in table.status:
        features.append(_flag("TriggerArmed", TRIGGER_ARMED, "RO"))
    statuses = [status for status in ("ExposureActive", "FrameTriggerWait") if status in table.status]
    if statuses:
        index = '<pIndex Offset="0x4">AcquisitionStatusSelectorValue</pIndex>'
        features.append(_selector("AcquisitionStatusSelector", statuses))
        features.append(_flag("AcquisitionStatus", STATUS, "RO", index))
    if table.frame_rate:
        features.append(_flag(table.frame_rate, FRAME_RATE_ENABLE))
    return features


def _light(table: NodeMap) -> list[str]:
    low, high = table.exposure_us
    features = [
        f'<Float Name="{table.exposure}" NameSpace="Standard"><pValue>ExposureConverter</pValue><Min>{low}</Min>'
        f"<Max>{high}</Max><Inc>1</Inc></Float>",
        '<Converter Name="ExposureConverter"><FormulaTo>FROM</FormulaTo><FormulaFrom>TO</FormulaFrom>'
        "<pValue>ExposureRegister</pValue></Converter>",
        _register("Exposure", EXPOSURE_US),
        _choice("GainAuto", GAIN_AUTO, {"Off": 0, "Once": 1, "Continuous": 2}),
    ]
    for name, number, raw, limits in (
        (table.gain, GAIN_DB, GAIN_RAW, table.gain_range),
        (table.black_level, BLACK_LEVEL, BLACK_LEVEL_RAW, table.black_level_range),
    ):
        if name.endswith("Raw"):
            features.append(_integer(name, raw, int(limits[0]), int(limits[1])))
        else:
            features.append(_float(name, number, *limits, unit="dB" if name == "Gain" else ""))
    if table.gamma is not None:
        features.append(_float("Gamma", GAMMA, 0.25, 4.0))
    if table.gamma == "GammaEnable":
        features.append(_flag("GammaEnable", GAMMA_ENABLE))
    return features


def _clock(table: NodeMap) -> list[str]:
    if table.ptp is None:
        return []
    status = "PtpStatus" if table.ptp == "PtpEnable" else "GevIEEE1588Status"
    states = {"Disabled": 0, "Listening": 1, "Slave": 2, "Master": 3}
    return [_flag(table.ptp, PTP_ENABLE), _choice(status, PTP_STATUS, states)]


def _payload_size(table: NodeMap) -> str:
    image = "W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8"
    sizes = {"W": "Width", "H": "Height", "F": "PixelFormat"}
    if not table.chunk_timestamp:
        return _formula("PayloadSize", image, **sizes)
    return _formula("PayloadSize", f"{image} + C * {CHUNK_BYTES}", **sizes, C="ChunkModeActiveRegister")


def _chunks(table: NodeMap) -> list[str]:
    if not table.chunk_timestamp:
        return []
    return [
        _flag("ChunkModeActive", CHUNK_MODE),
        _selector("ChunkSelector", ["Timestamp"]),
        _flag("ChunkEnable", CHUNK_TIMESTAMP_ENABLE),
        f'<Port Name="TimestampChunk"><ChunkID>{TIMESTAMP_CHUNK:x}</ChunkID></Port>',
        '<Integer Name="ChunkTimestamp"><pValue>ChunkTimestampRegister</pValue></Integer>',
        '<IntReg Name="ChunkTimestampRegister"><Address>0</Address><Length>8</Length><AccessMode>RO</AccessMode>'
        "<pPort>TimestampChunk</pPort><Cachable>NoCache</Cachable><Sign>Unsigned</Sign>"
        "<Endianess>BigEndian</Endianess></IntReg>",
    ]
