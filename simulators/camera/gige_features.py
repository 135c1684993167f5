"""The GenICam description of the simulated camera: a small SFNC camera whose registers are Aravis' fake memory.

Aravis serves any description over the wire; its fake camera gives meaning to the registers below 0x310 (size,
exposure, trigger, pixel format), the others are plain memory here.
"""

from __future__ import annotations

from drivers.pixel_formats import PIXEL_FORMATS

SENSOR_HEIGHT, SENSOR_WIDTH = 0x118, 0x11C
WIDTH, HEIGHT, BINNING_X, BINNING_Y = 0x100, 0x104, 0x108, 0x10C
EXPOSURE_US, PIXEL_FORMAT, OFFSET_X, OFFSET_Y = 0x120, 0x128, 0x130, 0x134
# 64-bit big-endian floats in memory that Aravis leaves alone.
GAIN_DB, BLACK_LEVEL, TEMPERATURE_C, GAMMA = 0x4000, 0x4008, 0x4010, 0x4018
# Automatic modes and gamma are on at power-up, as they are on many cameras.
GAIN_AUTO, GAMMA_ENABLE = 0x4020, 0x4024
REVERSE_X, REVERSE_Y, DECIMATION_X, DECIMATION_Y = 0x4028, 0x402C, 0x4030, 0x4034
TRIGGER_SOURCE = 0x304
# Reads 1 from the trigger until the exposure has ended.
SOFTWARE_TRIGGER = 0x30C
# Reads 1 while a trigger would be heeded; the camera itself keeps it up to date.
TRIGGER_ARMED = 0x4038

# The camera answers no command while it exposes, and its controller gives up after 3 s without an answer.
MAX_EXPOSURE_S = 2.0


def _register(name: str, address: int, kind: str = "IntReg", access: str = "RW", index: str = "") -> str:
    length, sign = (8, "") if kind == "FloatReg" else (4, "<Sign>Unsigned</Sign>")
    if 0x300 <= address < SOFTWARE_TRIGGER:
        index = '<pIndex Offset="0x20">TriggerSelectorValue</pIndex>'
    return (
        f'<{kind} Name="{name}Register"><Address>{address:#x}</Address>{index}<Length>{length}</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>{sign}"
        f"<Endianess>BigEndian</Endianess></{kind}>"
    )


def _integer(name: str, address: int, low: int, high: int | str, access: str = "RW") -> str:
    top = f"<Max>{high}</Max>" if isinstance(high, int) else f"<pMax>{high}</pMax>"
    return (
        f'<Integer Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue><Min>{low}</Min>{top}<Inc>1</Inc>'
        f"</Integer>{_register(name, address, access=access)}"
    )


def _float(name: str, address: int, low: float, high: float, access: str = "RW") -> str:
    return (
        f'<Float Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue><Min>{low}</Min><Max>{high}</Max>'
        f"</Float>{_register(name, address, 'FloatReg', access)}"
    )


def _choice(name: str, address: int, entries: dict[str, int]) -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>'
        for entry, value in entries.items()
    )
    return (
        f'<Enumeration Name="{name}" NameSpace="Standard">{listed}<pValue>{name}Register</pValue></Enumeration>'
        f"{_register(name, address)}"
    )


def _selector(name: str, entries: list[str]) -> str:
    listed = "".join(f'<EnumEntry Name="{e}"><Value>{i}</Value></EnumEntry>' for i, e in enumerate(entries))
    return (
        f'<Integer Name="{name}Value"><Value>0</Value></Integer><Enumeration Name="{name}">{listed}'
        f"<pValue>{name}Value</pValue></Enumeration>"
    )


def _formula(name: str, formula: str, **variables: str) -> str:
    listed = "".join(f'<pVariable Name="{short}">{feature}</pVariable>' for short, feature in variables.items())
    return f'<IntSwissKnife Name="{name}" NameSpace="Standard">{listed}<Formula>{formula}</Formula></IntSwissKnife>'


def _flag(name: str, address: int, access: str = "RW", index: str = "") -> str:
    return (
        f'<Boolean Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue><OnValue>1</OnValue>'
        f"<OffValue>0</OffValue></Boolean>{_register(name, address, access=access, index=index)}"
    )


def _text(name: str, address: int, length: int) -> str:
    return (
        f'<StringReg Name="{name}" NameSpace="Standard"><Address>{address:#x}</Address><Length>{length}</Length>'
        "<AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
    )


def _command(name: str, address: int, value: int) -> str:
    return (
        f'<Command Name="{name}" NameSpace="Standard"><pValue>{name}Register</pValue>'
        f"<CommandValue>{value}</CommandValue></Command>{_register(name, address, access='WO')}"
    )


def sfnc_description(width: int, height: int) -> str:
    """Write the GenICam XML of a camera with an SFNC feature set and a sensor of the given size in pixels."""
    selected, status = "AcquisitionStatusSelectorValue", TRIGGER_ARMED - SOFTWARE_TRIGGER
    features = [
        _text("DeviceVendorName", 0x48, 32),
        _text("DeviceModelName", 0x68, 32),
        _text("DeviceVersion", 0x88, 32),
        _text("DeviceSerialNumber", 0xD8, 16),
        _float("DeviceTemperature", TEMPERATURE_C, -40.0, 100.0, "RO"),
        _integer("SensorWidth", SENSOR_WIDTH, 1, width, "RO"),
        _integer("SensorHeight", SENSOR_HEIGHT, 1, height, "RO"),
        _formula("WidthMax", f"{width} / (B * D)", B="BinningHorizontal", D="DecimationHorizontal"),
        _formula("HeightMax", f"{height} / (B * D)", B="BinningVertical", D="DecimationVertical"),
        _formula("OffsetXMax", "M - W", M="WidthMax", W="Width"),
        _formula("OffsetYMax", "M - H", M="HeightMax", H="Height"),
        _integer("Width", WIDTH, 1, "WidthMax"),
        _integer("Height", HEIGHT, 1, "HeightMax"),
        _integer("OffsetX", OFFSET_X, 0, "OffsetXMax"),
        _integer("OffsetY", OFFSET_Y, 0, "OffsetYMax"),
        _integer("BinningHorizontal", BINNING_X, 1, 4),
        _integer("BinningVertical", BINNING_Y, 1, 4),
        _integer("DecimationHorizontal", DECIMATION_X, 1, 4),
        _integer("DecimationVertical", DECIMATION_Y, 1, 4),
        _flag("ReverseX", REVERSE_X),
        _flag("ReverseY", REVERSE_Y),
        _choice("PixelFormat", PIXEL_FORMAT, {fmt.name: fmt.code for fmt in PIXEL_FORMATS}),
        _choice("AcquisitionMode", 0x12C, {"Continuous": 1, "SingleFrame": 2, "MultiFrame": 3}),
        _command("AcquisitionStart", 0x124, 1),
        '<Command Name="AcquisitionStop" NameSpace="Standard"><pValue>AcquisitionStartRegister</pValue>'
        "<CommandValue>0</CommandValue></Command>",
        _selector("TriggerSelector", ["FrameStart", "AcquisitionStart"]),
        _choice("TriggerMode", 0x300, {"Off": 0, "On": 1}),
        _choice("TriggerSource", TRIGGER_SOURCE, {"Line0": 0, "Software": 1}),
        _choice("TriggerActivation", 0x308, {"RisingEdge": 0, "FallingEdge": 1}),
        _command("TriggerSoftware", SOFTWARE_TRIGGER, 1),
        _selector("AcquisitionStatusSelector", ["ExposureActive", "FrameTriggerWait"]),
        _flag("AcquisitionStatus", SOFTWARE_TRIGGER, "RO", f'<pIndex Offset="{status:#x}">{selected}</pIndex>'),
        f'<Float Name="ExposureTime" NameSpace="Standard"><pValue>ExposureTimeConverter</pValue><Min>10</Min>'
        f"<Max>{MAX_EXPOSURE_S * 1e6}</Max><Inc>1</Inc></Float>",
        '<Converter Name="ExposureTimeConverter"><FormulaTo>FROM</FormulaTo><FormulaFrom>TO</FormulaFrom>'
        "<pValue>ExposureTimeRegister</pValue></Converter>",
        _register("ExposureTime", EXPOSURE_US),
        _float("Gain", GAIN_DB, 0.0, 24.0),
        _choice("GainAuto", GAIN_AUTO, {"Off": 0, "Once": 1, "Continuous": 2}),
        _float("BlackLevel", BLACK_LEVEL, 0.0, 511.0),
        _float("Gamma", GAMMA, 0.25, 4.0),
        _flag("GammaEnable", GAMMA_ENABLE),
        _formula("PayloadSize", "W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8", W="Width", H="Height", F="PixelFormat"),
        '<Port Name="Device" NameSpace="Standard"/>',
    ]
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<RegisterDescription ModelName="Loopback" VendorName="umov"'
        ' StandardNameSpace="None" SchemaMajorVersion="1" SchemaMinorVersion="0" SchemaSubMinorVersion="1"'
        ' MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0"'
        ' xmlns="http://www.genicam.org/GenApi/Version_1_0">\n'
        '<Category Name="Root" NameSpace="Standard"/>\n' + "\n".join(features) + "\n</RegisterDescription>\n"
    )
