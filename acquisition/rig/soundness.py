"""What a rig file says about itself that cannot be meant: names that are nowhere, two axes at one address, a park pose
outside the limits. Every mistake is found, none hides another; nothing is opened.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from acquisition.rig.way import find_homing_obstacle, find_obstacle
from drivers.axis_types import AxisConfig, Limits
from processing.storage.captures.schema import NOT_AXES
from processing.storage.formats.state_csv import NAME
from simulators.rig.model import SCHEME

if TYPE_CHECKING:
    from acquisition.rig.sections import RigSections

#: Prefix of the name of a port on the network.
SOCKET = "socket://"
#: An interlock on a higher temperature of a camera could not be meant.
HOTTEST_C = 150.0
#: Keys that lead to the place in the file, and the mistake there.
Mistake = tuple[tuple[int | str, ...], str]


def find_mistakes(rig: RigSections) -> list[Mistake]:
    """Everything that the sections of a rig file say about each other and cannot be meant.

    Parameters
    ----------
    rig : may lack what could not be read; an axis that could not be read is None.
    """
    looks: tuple[Callable[[RigSections], Iterator[Mistake]], ...] = (
        _axis_names,
        _names_in_captures,
        _axes_given_twice,
        _ports,
        _shared_places,
        _emulated_ports,
        _angles_outside_limits,
        _wavelengths,
        _detector,
        _interlocks,
        _solids,
        _ways,
    )
    return [mistake for look in looks for mistake in look(rig)]


def _named_axes(rig: RigSections) -> Iterator[tuple[tuple[int | str, ...], str]]:
    """Every place in the file that names an axis, with the name."""
    for section in ("park_deg", "backlash_deg", "homing", "fold_deg"):
        for name in getattr(rig, section):
            yield (section, name), name
    for section in ("home_order", "endless"):
        for k, name in enumerate(getattr(rig, section)):
            yield (section, k), name
    for k, box in enumerate(rig.forbidden):
        for name in box.ranges_deg:
            yield ("forbidden", k, "ranges_deg", name), name
    for mode, config in rig.modes.items():
        for name in config.pose_deg:
            yield ("modes", mode, "pose_deg", name), name
    for k, solid in enumerate(rig.solids.parts if rig.solids else ()):
        if solid.turns_with is not None:
            yield ("solids", "parts", k, "turns_with"), solid.turns_with
    for name in rig.simulator.axes if rig.simulator else ():
        yield ("simulator", "axes", name), name


def _axis_names(rig: RigSections) -> Iterator[Mistake]:
    for where, name in _named_axes(rig):
        if name not in rig.axes:
            near = difflib.get_close_matches(name, rig.axes, n=1)
            hint = f"; {near[0]} is meant?" if near else ""
            yield where, f"there is no axis {name!r}, only {', '.join(rig.axes)}{hint}"


def _names_in_captures(rig: RigSections) -> Iterator[Mistake]:
    """Each axis is a group in a capture file."""
    for name in rig.axes:
        if not NAME.fullmatch(name):
            yield ("axes", name), f"{name!r} is no name for an axis: letters, digits and _, and begin with a letter"
        elif name in NOT_AXES:
            yield ("axes", name), f"no axis can be called {name!r}; give it another name"


def _axes_given_twice(rig: RigSections) -> Iterator[Mistake]:
    for section in ("home_order", "endless"):
        names = getattr(rig, section)
        for k, name in enumerate(names):
            if name in names[:k]:
                yield (section, k), f"axis {name!r} is there twice"


def _ports(rig: RigSections) -> Iterator[Mistake]:
    for where, _, entry in _devices_with_port(rig):
        port = entry.port
        if not port.strip():
            yield (*where, "port"), "names no port"
        elif port.startswith(SOCKET) and not re.fullmatch(r"[^:/]+:\d{1,5}", port.removeprefix(SOCKET)):
            yield (*where, "port"), f"{port!r}: a network port is {SOCKET}ADDRESS:NUMBER"


def _shared_places(rig: RigSections) -> Iterator[Mistake]:
    """Two axes at one address, two kinds of device on one line, two rig axes on one emulated axis."""
    places: dict[tuple[str, str], str] = {}
    lines: dict[str, tuple[str, str]] = {}
    for where, name, entry in _devices_with_port(rig):
        port = os.path.realpath(entry.port) if entry.port.startswith("/") else entry.port
        owner, first_kind = lines.setdefault(port, (name, entry.kind))
        if first_kind != entry.kind:
            yield (*where, "port"), f"{entry.kind} at the port of {owner}, a {first_kind}: one line, one protocol"
            continue
        place = entry.place() if isinstance(entry, AxisConfig) else ""
        holder = places.setdefault((port, place), name)
        if holder != name:
            yield where, f"at the same port{' and ' + place if place else ''} as {holder}: one device cannot be both"
    emulated: dict[Any, str] = {}
    for name, axis in rig.simulator.axes.items() if rig.simulator else ():
        holder = emulated.setdefault((axis.port, axis.index), name)
        if holder != name:
            yield ("simulator", "axes", name), f"the same emulated axis as {holder}"


def _devices_with_port(rig: RigSections) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    yield from ((("axes", name), name, entry) for name, entry in rig.axes.items() if entry is not None)
    source = getattr(rig, "source", None)
    if getattr(source, "port", None) is not None:
        yield ("source",), "the source", source


def _emulated_ports(rig: RigSections) -> Iterator[Mistake]:
    if rig.simulator is None:
        return
    for where, _, entry in _devices_with_port(rig):
        if entry.port.startswith(SCHEME) and entry.port.removeprefix(SCHEME) not in rig.simulator.ports:
            yield (*where, "port"), f"port {entry.port}: `simulator.ports` has {', '.join(rig.simulator.ports)}"
    for name in rig.axes.keys() - rig.simulator.axes.keys():
        yield ("simulator", "axes"), f"axis {name!r} of the rig is not there"


def _angles_outside_limits(rig: RigSections) -> Iterator[Mistake]:
    for where, name, angle in _given_angles(rig):
        limits = Limits(*(getattr(rig.axes.get(name), "limits_deg", None) or (None, None)))
        if angle not in limits:
            yield where, f"{angle:g} deg lies outside the limits of {name}, {limits} deg"


def _given_angles(rig: RigSections) -> Iterator[tuple[tuple[int | str, ...], str, float]]:
    for name, angle in rig.park_deg.items():
        yield ("park_deg", name), name, angle
    for mode, config in rig.modes.items():
        for name, angles in config.pose_deg.items():
            for angle in angles.values() if isinstance(angles, dict) else (angles,):
                yield ("modes", mode, "pose_deg", name), name, angle


def _wavelengths(rig: RigSections) -> Iterator[Mistake]:
    wavelengths = rig.wavelengths_nm
    for k, wavelength in enumerate(wavelengths):
        if wavelength in wavelengths[:k]:
            yield ("wavelengths_nm", k), f"{wavelength:g} nm is there twice"
    for mode, config in rig.modes.items():
        for axis, angles in config.pose_deg.items():
            for wavelength in angles if isinstance(angles, dict) else ():
                if wavelength not in wavelengths:
                    where = ("modes", mode, "pose_deg", axis)
                    yield where, f"{wavelength:g} nm is none of `wavelengths_nm`"
    if rig.exposure_s[0] <= 0:
        yield ("exposure_s",), f"the shortest exposure must be positive, not {rig.exposure_s[0]:g} s"


def _detector(rig: RigSections) -> Iterator[Mistake]:
    detector = getattr(rig, "detector", None)
    if detector is None:
        return
    black, top = detector.black_level_counts, 2 ** (detector.bits or 32) - 1
    if not 0 <= black < top:
        yield ("detector", "black_level_counts"), f"{black:g} lies outside the counts, 0 to {top}"


def _interlocks(rig: RigSections) -> Iterator[Mistake]:
    kinds = [entry.kind for entry in rig.interlocks]
    for k, entry in enumerate(rig.interlocks):
        if entry.kind in kinds[:k]:
            yield ("interlocks", k), f"{entry.kind} is listed twice; one would be ignored"
        if entry.kind == "door" and getattr(rig, "source", None) is None:
            yield ("interlocks", k), "door: no source of the rig has an interlock circuit"
        if entry.kind == "door" and entry.limit:
            yield ("interlocks", k), "door: it is open or closed and has no limit"
        if entry.kind in ("temperature", "drift", "lamp") and entry.limit == 0:
            frequency = "always" if entry.kind == "lamp" else "never"
            yield ("interlocks", k), f"{entry.kind}: limit 0 is {frequency} kept; give a limit"
        if entry.kind in ("lamp", "saturation", "drift") and entry.limit >= 1:
            yield ("interlocks", k), f"{entry.kind}: limit {entry.limit:g} is a fraction, less than 1"
        if entry.kind == "temperature" and entry.limit > HOTTEST_C:
            yield ("interlocks", k), f"temperature: no camera reaches {entry.limit:g} degrees Celsius"


def _solids(rig: RigSections) -> Iterator[Mistake]:
    names = [solid.name for solid in rig.solids.parts] if rig.solids else []
    for k, name in enumerate(names):
        if name in names[:k]:
            yield ("solids", "parts", k, "name"), f"a solid {name!r} is there already"


def _ways(rig: RigSections) -> Iterator[Mistake]:
    """Parking and homing against forbidden poses and solids; asked only of names that are all there."""
    if any(name not in rig.axes for _, name in _named_axes(rig)):
        return
    obstacle = _park_meets(rig)
    if obstacle is not None:
        yield ("park_deg",), f"parking there meets {obstacle}"
    order: Iterable[str] = [*rig.home_order, *(name for name in rig.axes if name not in rig.home_order)]
    obstacle = find_homing_obstacle(rig, order, {})
    if obstacle is not None:
        yield ("homing",), obstacle


def _park_meets(rig: RigSections) -> str | None:
    """What is met in the park pose wherever the axes stand that are not parked."""
    park = rig.park_deg
    changes: dict[str, Any] = {"forbidden": tuple(box for box in rig.forbidden if box.ranges_deg.keys() <= park.keys())}
    if rig.solids is not None:
        parts = tuple(s for s in rig.solids.parts if s.turns_with is None or s.turns_with in park)
        changes["solids"] = rig.solids.model_copy(update={"parts": parts})
    return find_obstacle(rig.model_copy(update=changes), park, park)
