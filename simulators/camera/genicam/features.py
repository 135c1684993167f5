"""The features of a description that a camera does something about, by their standard (SFNC) names."""

import contextlib
import math
from collections.abc import Iterator, Sequence

from drivers.exposure_and_gain import gain_unit
from drivers.genicam import BLACK_LEVEL, GAIN_DB, GAIN_RAW
from simulators.camera.exposure import ExposureInfo
from simulators.camera.genicam.formula import Number
from simulators.camera.genicam.node_tree import REGISTERS, NodeError, NodeTree
from simulators.camera.genicam.power_up import EXPOSURES, follow, tell, tell_flag

START, STOP, TRIGGER = "AcquisitionStart", "AcquisitionStop", "TriggerSoftware"
#: Commands that bring the settings of the chosen set back.
LOADS = ("UserSetLoad", "ConfigFileLoad")
# Each by one of its names; a camera without them cannot be triggered by a program.
_NEEDED = (
    *(("Width",), ("Height",), ("PixelFormat",), EXPOSURES),
    *(("TriggerMode",), ("TriggerSource",), (TRIGGER,), (START,), (STOP,)),
)
_NUMBERS = ("OffsetX", "OffsetY", "BinningHorizontal", "DecimationHorizontal", "ReverseX", "ReverseY", "PayloadSize")
_STATUS = ("AcquisitionStatusSelector", "AcquisitionStatus")
# What chunks add behind the image: its own number and length, and a time with the same.
_IMAGE_CHUNK_BYTES = 8


class FeatureValues:
    """Settings and status of the camera.

    Parameters
    ----------
    nodes : powered up.
    sensor : width and height in pixels.
    complete : False plays a camera whose features do not suffice for a capture.

    Raises
    ------
    NodeError
        A feature that is needed is not there or cannot be played.
    """

    def __init__(self, nodes: NodeTree, sensor: tuple[int, int], *, complete: bool = True) -> None:
        self._nodes, self._sensor = nodes, sensor
        self._exposing, self._armed = False, True
        for names in _NEEDED if complete else ():
            self._require(names)
        if "PayloadSize" not in nodes:
            raise nodes.error("PayloadSize", "is missing, and a capture needs it")
        for name in ("Width", "Height", *EXPOSURES, *_NUMBERS, *GAIN_DB, *GAIN_RAW, *BLACK_LEVEL):
            if self._is_available(name):
                nodes.value(name)
                nodes.limit(name, "Min")
                nodes.limit(name, "Max")
        self._commands = dict(self._all_commands())
        self.follow()
        self.show(exposing=False, armed=True)

    def _require(self, names: Sequence[str]) -> None:
        name = self._first(names)
        if name is None:
            feature = next((name for name in names if name in self._nodes), names[0])
            missing = "is not available" if feature in self._nodes else "is missing, and a capture needs it"
            raise self._nodes.error(feature, missing)
        with self._frame_start():
            end = self._nodes.end(name)
            if self._nodes.node(end).tag not in REGISTERS:
                raise self._nodes.error(name, f"ends in {end}, which is no register: the camera would never hear of it")
            self._nodes.value(name)

    def _frame_start(self) -> contextlib.AbstractContextManager[None]:
        return self._nodes.assuming("TriggerSelector", "FrameStart")

    def _is_available(self, name: str) -> bool:
        if name not in self._nodes:
            return False
        node = self._nodes.node(name)
        return self._nodes.is_true(node, "pIsImplemented") and self._nodes.is_true(node, "pIsAvailable")

    def _first(self, names: Sequence[str]) -> str | None:
        return next((name for name in names if self._is_available(name)), None)

    def _number(self, names: Sequence[str], otherwise: Number) -> Number:
        name = self._first(names)
        return otherwise if name is None else self._nodes.value(name)

    def _flag(self, name: str) -> bool:
        if not self._is_available(name):
            return False
        return self._nodes.value(name) == int(self._nodes.node(name).findtext("OnValue") or 1)

    def number(self, name: str) -> float | None:
        """A number, or None where the camera has it not."""
        with self._frame_start():
            return float(self._nodes.value(name)) if self._is_available(name) else None

    def entry(self, name: str) -> str | None:
        """The chosen entry of an enumeration; "Off" or "On" of a flag; None where the camera has it not."""
        if not self._is_available(name):
            return None
        if self._nodes.node(name).tag == "Enumeration":
            return self._nodes.chosen(name)
        return "On" if self._flag(name) else "Off"

    # --- what it is set to -------------------------------------------------------------------------------

    def info(self, frame_id: int) -> ExposureInfo:
        """Settings of an exposure that begins now."""
        number = self._number
        return ExposureInfo(
            exposure_s=number(EXPOSURES, 0) * 1e-6,
            gain_db=self._gain_db(),
            black_level=float(number(BLACK_LEVEL, 0)),
            frame_id=frame_id,
            width=int(number(("Width",), 0)),
            height=int(number(("Height",), 0)),
            offset_x=int(number(("OffsetX",), 0)),
            offset_y=int(number(("OffsetY",), 0)),
            binning=int(number(("BinningHorizontal",), 1)),
            decimation=int(number(("DecimationHorizontal",), 1)),
            reverse_x=self._flag("ReverseX"),
            reverse_y=self._flag("ReverseY"),
        )

    def _gain_db(self) -> float:
        """Decibels of a Gain in decibels or as a factor; the number of any other gain."""
        name = self._first((*GAIN_DB, *GAIN_RAW))
        value = 0.0 if name is None else float(self._nodes.value(name))
        factor = name is not None and gain_unit(self._nodes.node(name).findtext("Unit") or "") == "factor"
        return 20 * math.log10(max(value, 1e-3)) if factor else value

    def pixel_format(self) -> tuple[int, str]:
        """Code and name of the pixel format."""
        return int(self._nodes.value("PixelFormat")), self._nodes.chosen("PixelFormat")

    def trigger_source(self) -> str | None:
        """What starts a frame; None where nothing has to."""
        if not (self._is_available("TriggerMode") and self._is_available("TriggerSource")):
            return None
        with self._frame_start():
            if self._nodes.chosen("TriggerMode") == "Off":
                return None
            return self._nodes.chosen("TriggerSource")

    def time_chunk(self, time_ns: int) -> dict[int, bytes] | None:
        """The chunk with the time of an exposure, by its number; empty if it is not enabled, None without chunks."""
        if not self._flag("ChunkModeActive"):
            return None
        nodes = self._nodes
        with nodes.assuming("ChunkSelector", "Timestamp"):
            if not self._flag("ChunkEnable") or "ChunkTimestamp" not in nodes:
                return {}
        end = nodes.end("ChunkTimestamp")
        port = nodes.node(nodes.node(end).findtext("pPort") or "")
        register = nodes.register(end)
        number = int(port.findtext("ChunkID") or "0", 16)
        return {number: time_ns.to_bytes(register.length, "big" if register.big_endian else "little")}

    # --- what it hears -----------------------------------------------------------------------------------

    def _all_commands(self) -> Iterator[tuple[str, Number]]:
        for name in self._nodes:
            node = self._nodes.node(name)
            if node.tag == "Command":
                # One that cannot be played is nothing that a capture needs: those have been looked at.
                with contextlib.suppress(NodeError):
                    self._nodes.register(self._nodes.end(name))
                    yield name, self._nodes.command_value(name)

    def heard(self, address: int, count: int) -> list[str]:
        """Commands that were given by writing these bytes; their registers go back to zero."""
        commands = []
        with self._frame_start():
            for name, code in self._commands.items():
                end = self._nodes.end(name)
                if self._nodes.register(end).overlaps(address, count) and self._nodes.value(end) == code:
                    commands.append(name)
            for name in commands:
                self._nodes.set_value(self._nodes.end(name), 0)
        return commands

    # --- what it tells -----------------------------------------------------------------------------------

    def follow(self) -> None:
        """Bring what depends on the settings up to date."""
        follow(self._nodes, self._sensor)
        nodes = self._nodes
        if "PayloadSize" in nodes and nodes.node(nodes.end("PayloadSize")).tag in REGISTERS:
            code = int(nodes.value("PixelFormat"))
            pixels = int(nodes.value("Width")) * int(nodes.value("Height"))
            chunks = self.time_chunk(0)
            chunk_bytes = 0 if chunks is None else _IMAGE_CHUNK_BYTES + sum(8 + len(data) for data in chunks.values())
            tell(nodes, "PayloadSize", (pixels * (code >> 16 & 0xFF) + 7) // 8 + chunk_bytes)
        self.show(exposing=self._exposing, armed=self._armed)

    def show(self, *, exposing: bool, armed: bool) -> None:
        """Tell the state of the exposure: TriggerArmed, and AcquisitionStatus for every entry of its selector."""
        self._exposing, self._armed = exposing, armed
        nodes, (selector, status) = self._nodes, _STATUS
        if self._is_available("TriggerArmed"):
            self._tell_flag("TriggerArmed", armed)
        if not (self._is_available(selector) and self._is_available(status)):
            return
        states = {"ExposureActive": exposing, "FrameActive": exposing, "FrameTriggerWait": armed}
        now = nodes.chosen(selector)
        # The selected one last: some cameras have one register for all.
        for entry in sorted(nodes.entries(selector), key=lambda entry: entry == now):
            with nodes.assuming(selector, entry):
                self._tell_flag(status, states.get(entry, False))

    def _tell_flag(self, name: str, on: bool) -> None:
        node = self._nodes.node(name)
        value = int(node.findtext("OnValue") or 1) if on else int(node.findtext("OffValue") or 0)
        end = self._nodes.end(name)
        if self._nodes.node(end).tag in REGISTERS:
            self._nodes.set_value(end, value)
        elif not tell_flag(self._nodes, name, value):
            raise self._nodes.error(name, "is calculated in a way that cannot be played")
