"""Settings of a played camera when it is switched on, and values that follow from its settings.

A description says where values stand, not which ones a camera has there. So its memory begins with zeros, and from
them every feature is given the nearest value that its description allows: what can be implemented is, what can be
locked is not, an enumeration stands at its first entry, a number at its lower limit. Registers that programs can only
read are the camera's own, so those are written to until a feature comes out as it should.
"""

import contextlib
from collections.abc import Callable, Sequence

from drivers.genicam import EXPOSURE_US
from drivers.pixel_formats import PIXEL_FORMATS
from simulators.camera.genicam.formula import Number
from simulators.camera.genicam.node_tree import NodeError, NodeTree

EXPOSURES = (*EXPOSURE_US, "ExposureTimeRaw")
START_EXPOSURE_US = 10_000
TEMPERATURE_C = 38.5
# Upper limits where a camera keeps them in a register; microseconds, decibels, counts.
_USUAL_MAX = {
    **dict.fromkeys(EXPOSURES, 10_000_000),
    "Gain": 24,
    "GainRaw": 240,
    "BlackLevel": 255,
    "BlackLevelRaw": 255,
    "Gamma": 4,
    "BinningHorizontal": 4,
    "BinningVertical": 4,
    "DecimationHorizontal": 4,
    "DecimationVertical": 4,
    "GevSCPSPacketSize": 9000,
    "DeviceTemperature": 100,
    "TemperatureAbs": 100,
}
_LARGE = ((1 << 31) - 1, (1 << 15) - 1, 255, 1)
_ALL_ONES = (1 << 64) - 1
_AT_LEAST_ONE = ("BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical")


def power_up(nodes: NodeTree, sensor: tuple[int, int], texts: dict[str, str]) -> None:
    """Give every feature a value; those that a capture needs must come out right.

    Parameters
    ----------
    sensor : width and height in pixels.
    texts : vendor, model and so on by the name of the feature.

    Raises
    ------
    NodeError
        The description has another sensor written down.
    """
    for name in list(nodes):
        _settle(nodes, name)
        # A selected feature has a value for each entry of its selector.
        selected = [child.text or "" for child in nodes.node(name).findall("pSelected")]
        for entry in _entries(nodes, name) if selected else ():
            with nodes.assuming(name, entry):
                for feature in selected:
                    _settle(nodes, feature)
    for name, text in texts.items():
        if name in nodes:
            nodes.set_text(name, text)
    follow(nodes, sensor)
    for name, key, full in zip(("Width", "Height"), ("columns", "rows"), sensor, strict=True):
        for maximum in (f"Sensor{name}", f"{name}Max"):
            if maximum in nodes:
                _require_size(nodes, maximum, nodes.value(maximum), key, full=full)
        _require_size(nodes, name, nodes.limit(name, "Max"), key, full=full)
        nodes.set_value(name, full)
    _set_light(nodes)
    _choose(nodes, "PixelFormat", _first_format(nodes))
    _choose(nodes, "AcquisitionMode", "Continuous")
    _choose(nodes, "TriggerSelector", "FrameStart")
    follow(nodes, sensor)


def follow(nodes: NodeTree, sensor: tuple[int, int]) -> None:
    """Bring the limits of the region and the size of a frame up to date, where the camera keeps them in registers."""
    for size, offset, sensor_size, direction, full in (
        ("Width", "OffsetX", "SensorWidth", "Horizontal", sensor[0]),
        ("Height", "OffsetY", "SensorHeight", "Vertical", sensor[1]),
    ):
        span = full // int(_optional(nodes, f"Binning{direction}") * _optional(nodes, f"Decimation{direction}"))
        registers: set[str] = set()
        for name, value in ((sensor_size, full), (f"{size}Max", span), (nodes.limit_node(size, "Max"), span)):
            if name is not None and name in nodes:
                tell(nodes, name, value)
                registers |= nodes.inputs(name)
        top = nodes.limit_node(offset, "Max") if offset in nodes else None
        # On some cameras an offset may be anywhere on the sensor, for every width.
        if top is not None and not registers & nodes.inputs(top):
            tell(nodes, top, max(0, span - int(nodes.value(size))))


def tell(nodes: NodeTree, name: str, value: Number) -> bool:
    """Give a node a value through registers that only the camera writes; False if it does not work."""
    return _make(nodes, name, lambda now: now == value, (value,))


def tell_flag(nodes: NodeTree, name: str, value: int) -> bool:
    """The same for a flag that may be one of many in a register: one bit is turned over, and the others stay."""
    if nodes.value(name) == value:
        return True
    for register in sorted(nodes.inputs(name)):
        if not nodes.is_the_cameras_own(register):
            continue
        before = int(nodes.value(register))
        for bit in range(8 * nodes.register(register).length):
            nodes.set_value(register, before ^ 1 << bit)
            if nodes.value(name) == value:
                return True
        nodes.set_value(register, before)
    return False


def _make(nodes: NodeTree, name: str, good: Callable[[Number], bool], candidates: Sequence[Number]) -> bool:
    if good(nodes.value(name)):
        return True
    adjustable = [register for register in sorted(nodes.inputs(name)) if nodes.is_the_cameras_own(register)]
    # One after another, and all of them together for a formula with several registers.
    for registers in (*([register] for register in adjustable), adjustable):
        before = {register: nodes.value(register) for register in registers}
        for candidate in candidates:
            for register in registers:
                nodes.set_value(register, candidate)
            # In the wrong register it may leave a formula without a value.
            with contextlib.suppress(NodeError):
                if good(nodes.value(name)):
                    return True
        for register, value in before.items():
            nodes.set_value(register, value)
    return False


def _settle(nodes: NodeTree, name: str) -> None:
    for step in (_revive, _unhide, _open_limits, _into_limits):
        # Most features are never asked for; those that are, are looked at when the camera starts.
        with contextlib.suppress(NodeError):
            step(nodes, name)


def _entries(nodes: NodeTree, name: str) -> list[str]:
    with contextlib.suppress(NodeError):
        return list(nodes.entries(name)) if nodes.node(name).tag == "Enumeration" else []
    return []


def _require_size(nodes: NodeTree, name: str, says: Number | None, key: str, *, full: int) -> None:
    if says != full:
        raise nodes.error(
            name,
            f"says {says} in a way that the camera cannot change, and the simulated sensor has {full}: set `{key}` to "
            f"{says} in the section `simulator` of the rig file",
        )


def _revive(nodes: NodeTree, name: str) -> None:
    """Let a formula have a value that divides by a register which begins at zero."""
    for register in sorted(nodes.inputs(name)) if nodes.node(name).findtext("Formula") else ():
        try:
            nodes.value(name)
            return
        except NodeError:
            if not nodes.value(register):
                nodes.set_value(register, 1)


def _unhide(nodes: NodeTree, name: str) -> None:
    for node in (nodes.node(name), *nodes.node(name).iter("EnumEntry")):
        for condition, state in (("pIsImplemented", True), ("pIsAvailable", True), ("pIsLocked", False)):
            reference = node.findtext(condition)
            if reference is not None:
                _make(nodes, reference, lambda now, state=state: bool(now) == state, (_ALL_ONES, 1, 0))  # type: ignore[misc]


def _open_limits(nodes: NodeTree, name: str) -> None:
    if nodes.node(name).tag not in ("Integer", "Float"):
        return
    step, top = nodes.limit_node(name, "Inc"), nodes.limit_node(name, "Max")
    if step is not None:
        _make(nodes, step, lambda now: now > 0, (1,))
    if top is not None:
        low = nodes.limit(name, "Min") or 0
        _make(nodes, top, lambda now: now > low, (_USUAL_MAX.get(name, _LARGE[0]), *_LARGE))


def _into_limits(nodes: NodeTree, name: str) -> None:
    tag, value = nodes.node(name).tag, nodes.value(name)
    if tag == "Enumeration":
        codes = list(nodes.entries(name).values())
        if codes and value not in codes:
            nodes.set_value(name, codes[0])
    elif tag in ("Integer", "Float"):
        low, high = nodes.limit(name, "Min"), nodes.limit(name, "Max")
        low = 1 if not low and name in _AT_LEAST_ONE else low
        if low is not None and value < low:
            nodes.set_value(name, low)
        elif high is not None and value > high:
            nodes.set_value(name, high)


def _set_light(nodes: NodeTree) -> None:
    for name in EXPOSURES:
        if name in nodes:
            low, high = nodes.limit(name, "Min"), nodes.limit(name, "Max")
            nodes.set_value(name, min(max(START_EXPOSURE_US, low or 0), high or START_EXPOSURE_US))
            break
    for name in ("DeviceTemperature", "TemperatureAbs"):
        if name in nodes:
            with contextlib.suppress(NodeError):
                nodes.set_value(name, TEMPERATURE_C)


def _first_format(nodes: NodeTree) -> str:
    formats = {fmt.name for fmt in PIXEL_FORMATS}
    offered = [name for name in nodes.entries("PixelFormat") if name in formats]
    if not offered:
        raise nodes.error(
            "PixelFormat", f"has no format that is known here, but {', '.join(nodes.entries('PixelFormat'))}"
        )
    return "Mono16" if "Mono16" in offered else offered[0]


def _choose(nodes: NodeTree, name: str, entry: str) -> None:
    if name in nodes and entry in nodes.entries(name):
        nodes.choose(name, entry)


def _optional(nodes: NodeTree, name: str) -> Number:
    return max(1, nodes.value(name)) if name in nodes else 1
