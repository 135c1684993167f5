"""GenICam features by their standard (SFNC) and their older names, written within their limits and read back.

Cameras accept values that they do not keep: on Aravis' own camera an exposure of 1e12 us was taken and read back
as 3.57e9. So limits are checked before a value is written, and what is read back decides.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

from drivers.errors import CameraError, CameraLost, SettingRefused

# The SFNC name first, then what cameras before SFNC 2 call it.
EXPOSURE_US = ("ExposureTime", "ExposureTimeAbs")
GAIN_DB = ("Gain", "GainAbs")
GAIN_RAW = ("GainRaw",)
#: Bits of the converter behind the pixel format: FLIR, Lucid, Basler, Adimec.
CONVERTER_BITS = ("AdcBitDepth", "ADCBitDepth", "BslSensorBitDepth", "SensorBitDepth")
BLACK_LEVEL = ("BlackLevel", "BlackLevelAbs", "BlackLevelRaw")
TEMPERATURE_C = ("DeviceTemperature", "TemperatureAbs")
SENSOR_WIDTH = ("SensorWidth", "WidthMax")
SENSOR_HEIGHT = ("SensorHeight", "HeightMax")
PACKET_DELAY = ("GevSCPD",)
SERIAL_NUMBER = ("DeviceSerialNumber", "DeviceID")
FIRMWARE = ("DeviceFirmwareVersion", "DeviceVersion")

T = TypeVar("T")


class Features:
    """The features of one camera.

    Parameters
    ----------
    name : name of the camera in messages.
    aravis, glib_error :
        The Aravis module and GLib's exception class, which are imported late.
    camera :
        The open `Aravis.Camera`.
    """

    def __init__(self, name: str, aravis: Any, glib_error: Any, camera: Any) -> None:
        self._name = name
        self._aravis = aravis
        self._glib_error = glib_error
        self._camera = camera
        self._device = camera.get_device()
        self._is_lost = False
        self._selectors: dict[str, str] | None = None

    def release(self) -> None:
        """Drop the references to the camera."""
        self._camera = self._device = None

    @contextmanager
    def asking(self, what: str) -> Iterator[None]:
        """Turn an error of Aravis inside the block into one of ours; `what` says what was asked."""
        try:
            yield
        except self._glib_error as error:
            codes = self._aravis.DeviceError
            gone = (codes.TIMEOUT, codes.NOT_CONNECTED, codes.NOT_CONTROLLER, codes.TRANSFER_ERROR)
            quark = self._aravis.device_error_quark()
            if self.control_is_lost() or any(error.matches(quark, code) for code in gone):
                raise self.lost(what, str(error.message)) from error
            raise CameraError(
                f"camera {self._name}, {what}",
                str(error.message),
                "Look the feature up in the camera's manual, or with `arv-tool-0.8 features`",
            ) from error

    def control_is_lost(self) -> bool:
        """True once the camera no longer answers or obeys: a command told, or Aravis' heartbeat."""
        return self._is_lost or (isinstance(self._device, self._aravis.GvDevice) and not self._device.is_controller())

    def lost(self, what: str, came_back: str) -> CameraLost:
        """Make the error for a camera that is gone; from then on it is asked nothing more."""
        self._is_lost = True
        return CameraLost(
            f"camera {self._name}, {what}",
            f"the camera does not answer or obeys another program ({came_back})",
            "Check its power and cable and that no other program opens it, then open it again",
        )

    def find(self, names: tuple[str, ...]) -> str | None:
        """The first of the names that this camera has available now."""
        return next((name for name in names if self._camera.is_feature_available(name)), None)

    def number(self, names: tuple[str, ...]) -> float | None:
        """Read a number by any of its names; None where the camera has none of them."""
        name = self.find(names)
        if name is None:
            return None
        with self.asking(f"read {name}"):
            if self.is_float(name):
                return float(self._camera.get_float(name))
            return float(self._camera.get_integer(name))

    def text(self, names: tuple[str, ...]) -> str:
        """Read a text by any of its names; empty where the camera has none of them."""
        name = self.find(names)
        if name is None:
            return ""
        with self.asking(f"read {name}"):
            return str(self._camera.get_string(name))

    def set_number(self, names: tuple[str, ...], value: float, floor: float = 0.0) -> float:
        """Write a number within its limits and return what was read back.

        Parameters
        ----------
        names : names to look for, the standard one first.
        value : rounded for a feature of whole numbers.
        floor : largest harmless difference where the feature states no step of its own.

        Raises
        ------
        SettingRefused
            No such feature, out of its limits, or read back different by more than its step (or `floor`, or 0.1 %).
        """
        name = self.find(names)
        if name is None:
            raise self.refused(f"set {names[0]} to {value:g}", "this camera has no such feature")
        with self.asking(f"set {name} to {value:g}"):
            if self.is_float(name):
                low, high = self._camera.get_float_bounds(name)
                step = max(self._step(name), floor, 1e-3 * abs(value))
                self._check_limits(name, value, low, high)
                self._camera.set_float(name, value)
                back = float(self._camera.get_float(name))
            else:
                low, high = self._camera.get_integer_bounds(name)
                value, step = round(value), 0
                self._check_limits(name, value, low, high)
                self._check_increment(name, round(value), round(low))
                self._camera.set_integer(name, value)
                back = float(self._camera.get_integer(name))
        if not abs(back - value) <= step:
            raise self.refused(f"set {name} to {value:g}", f"it reads back {back:g}")
        return back

    def set_choice(self, name: str, value: str) -> None:
        """Choose one entry of an enumeration and read it back.

        Raises SettingRefused: the camera has no such entry or reads back another.
        """
        with self.asking(f"set {name} to {value}"):
            entries = list(self._camera.dup_available_enumerations_as_strings(name))
            if value not in entries:
                raise self.refused(f"set {name} to {value}", f"this camera offers {', '.join(entries)}")
            self._camera.set_string(name, value)
            back = self._camera.get_string(name)
        if back != value:
            raise self.refused(f"set {name} to {value}", f"it reads back {back}")

    def switch_off(self, name: str) -> None:
        """Switch a yes-or-no feature or an automatic mode off, where the camera has it."""
        if not self._camera.is_feature_available(name):
            return
        if isinstance(self._device.get_feature(name), self._aravis.GcEnumeration):
            self.set_choice(name, "Off")
            return
        self.set_flag(name, False)

    def set_flag(self, name: str, on: bool) -> None:
        """Switch a yes-or-no feature and read it back. Raises SettingRefused: it stays as it was."""
        wanted = "on" if on else "off"
        with self.asking(f"switch {name} {wanted}"):
            if bool(self._camera.get_boolean(name)) == on:
                return
            self._camera.set_boolean(name, on)
            if bool(self._camera.get_boolean(name)) != on:
                raise self.refused(f"switch {name} {wanted}", f"it stays {'off' if on else 'on'}")

    def set_value(self, name: str, value: bool | int | float | str) -> None:
        """Set any feature to a value of its own kind and read it back.

        Raises SettingRefused: no such feature, a command, one that can only be read, a value of another kind, out of
        its limits, or read back different.
        """
        asked = f"set {name} to {value}"
        if self.find((name,)) is None:
            raise self.refused(asked, "this camera has no such feature now")
        node, kinds = self._device.get_feature(name), self._aravis
        if isinstance(node, kinds.GcCommand):
            raise self.refused(asked, "it is a command and holds no value")
        with self.asking(f"look up {name}"):
            if node.get_actual_access_mode() == kinds.GcAccessMode.RO:
                raise self.refused(asked, "it can only be read")
        # An enumeration is a number and a text to Aravis as well.
        if isinstance(node, kinds.GcBoolean):
            self.set_flag(name, self._of_kind(name, value, bool, "true or false"))
        elif isinstance(node, kinds.GcEnumeration):
            self.set_choice(name, self._of_kind(name, value, str, f"one of {', '.join(self.choices(name))}"))
        elif isinstance(node, kinds.GcInteger | kinds.GcFloat):
            if isinstance(value, bool | str) or (isinstance(node, kinds.GcInteger) and value != int(value)):
                raise self.refused(asked, f"it takes a {'whole ' if isinstance(node, kinds.GcInteger) else ''}number")
            self.set_number((name,), value)
        elif isinstance(node, kinds.GcString):
            self._set_text(name, self._of_kind(name, value, str, "a text"))
        else:
            raise self.refused(asked, "it is no feature with a value")

    def _of_kind(self, name: str, value: object, kind: type[T], wanted: str) -> T:
        if not isinstance(value, kind):
            raise self.refused(f"set {name} to {value}", f"it takes {wanted}")
        return value

    def _set_text(self, name: str, text: str) -> None:
        with self.asking(f"set {name} to {text}"):
            self._camera.set_string(name, text)
            back = str(self._camera.get_string(name))
        if back != text:
            raise self.refused(f"set {name} to {text}", f"it reads back {back!r}")

    def dump(self) -> dict[str, str]:
        """Every feature under the root category that can be read now, as text, in the order of the node map."""
        nodes = self._device.get_genicam()
        found: dict[str, str] = {}
        self._dump(nodes, "Root", found)
        return found

    def _dump(self, nodes: Any, name: str, found: dict[str, str]) -> None:
        node = nodes.get_node(name)
        if isinstance(node, self._aravis.GcCategory):
            for entry in node.get_features():
                self._dump(nodes, entry, found)
            return
        if not isinstance(node, self._aravis.GcFeatureNode) or isinstance(node, self._aravis.GcCommand):
            return
        try:
            if node.is_available():
                found[name] = str(node.get_value_as_string())
        except self._glib_error as error:
            # One feature that cannot be read, such as a write-only one, must not cost the others.
            found[name] = f"not readable: {error.message}"

    def names(self) -> list[str]:
        """Names of every feature under the root category, commands included, in the order of the node map."""
        return list(self._listed(self._device.get_genicam(), "Root"))

    def _listed(self, nodes: Any, name: str) -> Iterator[str]:
        node = nodes.get_node(name)
        if isinstance(node, self._aravis.GcCategory):
            for entry in node.get_features():
                yield from self._listed(nodes, entry)
        elif isinstance(node, self._aravis.GcFeatureNode):
            yield name

    def writable(self) -> list[str]:
        """Names of the features that hold a value which can be set now, as far as the camera tells."""
        kinds = self._aravis
        return [
            name
            for name in self.names()
            if self.kind(name) in ("flag", "choice", "number")
            and self._device.get_feature(name).get_actual_access_mode() != kinds.GcAccessMode.RO
            and self._camera.is_feature_available(name)
        ]

    def kind(self, name: str) -> Literal["flag", "choice", "number", "text", "other"]:
        """What a feature holds."""
        node, kinds = self._device.get_feature(name), self._aravis
        if isinstance(node, kinds.GcBoolean):
            return "flag"
        # An enumeration is a number and a text to Aravis as well.
        if isinstance(node, kinds.GcEnumeration):
            return "choice"
        if isinstance(node, kinds.GcCommand | kinds.GcCategory):
            return "other"
        if isinstance(node, kinds.GcInteger | kinds.GcFloat):
            return "number"
        return "text" if isinstance(node, kinds.GcString) else "other"

    def value(self, name: str) -> bool | float | str | None:
        """Read a feature of any kind; None where the camera has it not now."""
        if self.find((name,)) is None:
            return None
        kind = self.kind(name)
        if kind == "flag":
            return self.flag(name)
        return self.number((name,)) if kind == "number" else self.text((name,))

    def limits(self, name: str) -> tuple[float, float]:
        """Lowest and highest value of a number now."""
        with self.asking(f"read the limits of {name}"):
            is_float = self.is_float(name)
            low, high = (self._camera.get_float_bounds if is_float else self._camera.get_integer_bounds)(name)
        return float(low), float(high)

    def unit(self, name: str) -> str:
        """Unit of a number as the description gives it; empty where it gives none."""
        node = self._device.get_feature(name)
        if not isinstance(node, self._aravis.GcFloat | self._aravis.GcInteger):
            return ""
        with self.asking(f"read the unit of {name}"):
            return str(node.get_unit() or "")

    def selector_of(self, name: str) -> str | None:
        """The feature that selects which of several values `name` is; None where the description names none."""
        if self._selectors is None:
            self._selectors = dict(self._all_selected())
        return self._selectors.get(name)

    def _all_selected(self) -> Iterator[tuple[str, str]]:
        for name in self.names():
            node = self._device.get_feature(name)
            if isinstance(node, self._aravis.GcSelector) and node.is_selector():
                for selected in node.get_selected_features():
                    yield selected.get_name(), name

    def flag(self, name: str) -> bool:
        """Read a yes-or-no feature that the camera is known to have."""
        with self.asking(f"read {name}"):
            return bool(self._camera.get_boolean(name))

    def optional_flag(self, name: str) -> bool | None:
        """Read a yes-or-no feature; None where the camera has none of that name."""
        return self.flag(name) if self.find((name,)) is not None else None

    def choices(self, name: str) -> list[str]:
        """Entries of an enumeration that can be chosen now; empty where the camera has none of that name."""
        if self.find((name,)) is None:
            return []
        with self.asking(f"read the entries of {name}"):
            return list(self._camera.dup_available_enumerations_as_strings(name))

    def command(self, name: str) -> None:
        """Execute a command feature."""
        with self.asking(f"execute {name}"):
            self._camera.execute_command(name)

    def is_float(self, name: str) -> bool:
        """True for a number that need not be whole."""
        return isinstance(self._device.get_feature(name), self._aravis.GcFloat)

    def _step(self, name: str) -> float:
        try:
            # The smallest positive double stands for no step.
            return float(self._camera.get_float_increment(name))
        except self._glib_error:
            return 0.0

    def _check_limits(self, name: str, value: float, low: float, high: float) -> None:
        if not low <= value <= high:
            raise self.refused(f"set {name} to {value:g}", f"its limits are {low:g} to {high:g} now")

    def largest(self, name: str, taken: int) -> int:
        """Largest value of a feature of whole numbers that leaves `taken` below its limit, in its steps."""
        with self.asking(f"read the limits of {name}"):
            low, high = (int(bound) for bound in self._camera.get_integer_bounds(name))
            step = self._increment(name)
        return low + max(0, high - taken - low) // step * step

    def _increment(self, name: str) -> int:
        try:
            return max(1, int(self._camera.get_integer_increment(name)))
        except self._glib_error:
            # Aravis' error for a bit field whose description states no step.
            return 1

    def _check_increment(self, name: str, value: int, low: int) -> None:
        step = self._increment(name)
        below = low + (value - low) // step * step
        if below != value:
            raise self.refused(f"set {name} to {value}", f"it goes in steps of {step}: {below} or {below + step}")

    def refused(self, what: str, came_back: str) -> SettingRefused:
        """The error of a setting that the camera does not take."""
        return SettingRefused(
            f"camera {self._name}, {what}", came_back, "Change the setting in the plan or the rig file"
        )
