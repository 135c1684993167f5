"""Identity of a capture's set-up, and the differences between two runs that should belong together.

Plan, rig, instrument, devices and program are the same in all parts of a capture. What may differ is where a device is
plugged in, and how far its counters are.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import Differs
from acquisition.rig.config import RigConfig
from acquisition.rig.rig import Rig
from drivers.camera import CameraSettings
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.captures.segments import Identity
from processing.yaml_file import named_files, parse_yaml

#: Keys of a rig file with a location or a recipient, which are not part of the identity.
PLACES = ("port", "device", "wire_log", "alert", "notify", "held_by")
#: Properties of a device that stay.
LASTING = (
    "kind", "vendor", "model", "serial_number", "firmware", "sensor_width", "sensor_height", "pixel_format", "bits",
)  # fmt: skip
#: Camera settings that the plan changes, or that concern the cable.
PASSING = ("exposure_s", "frame_average", "packet_size", "trigger")


def identity_of(plan: MeasurementPlan, config: RigConfig, instrument: InstrumentModel, rig: Rig | None) -> Identity:
    """Digests of the set-up of a run; without `rig`, of the files alone."""
    return Identity(
        simulated=config.simulated,
        plan=digest(plain(plan)),
        rig=digest(rig_content(config, plan.mode)),
        instrument=digest(plain(instrument)),
        software=f"umov {version('umov')}",
        files=files_of(config, plan.mode),
        devices={} if rig is None else device_properties(rig.describe()),
    )


def device_properties(devices: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, str]]:
    """The properties of devices that stay, as text."""
    return {name: {key: str(entry[key]) for key in LASTING if key in entry} for name, entry in devices.items()}


def places(devices: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Port or address of each device."""
    return {name: str(entry.get("port", entry.get("address", ""))) for name, entry in devices.items()}


def plain(model: BaseModel) -> Any:
    """A model as plain values."""
    return model.model_dump(mode="json", exclude_none=True)


def rig_content(config: RigConfig, mode: str) -> Any:
    """A rig file without places, files and the modes that this capture does not use."""
    tree = config.model_dump(mode="python", exclude_none=True)
    tree["modes"] = {mode: tree["modes"][mode]}
    return json.loads(json.dumps(_strip_places(tree), default=str))


def files_of(config: RigConfig, mode: str) -> dict[str, str]:
    """Digest of the content of each file that a rig file names, and of those that they name in turn.

    Not of the instrument, which is compared in words.
    """
    tree = config.model_dump(mode="python", exclude_none=True)
    tree.pop("modes")
    tree.pop("wire_log", None)
    digests: dict[str, str] = {}
    for key, path in _paths(tree, ""):
        nested = ((f"{key}.{name}", file) for name, file in named_files(path))
        for name, file in ((key, path), *nested):
            if os.path.isfile(file):
                digests[name] = hashlib.sha256(file.read_bytes()).hexdigest()
    return digests


def _optics(instrument: InstrumentModel) -> Any:
    """An instrument without its mosaic: that one is stored as the camera sees it and compared with the camera."""
    return {key: value for key, value in plain(instrument).items() if key != "mosaic"}


def digest(tree: Any) -> str:
    """SHA-256 of plain values, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()


def require_same(capture: Capture, plan: MeasurementPlan, config: RigConfig, instrument: InstrumentModel) -> None:
    """Refuse to continue a capture whose files differ from those that it was begun with.

    Raises Differs with every difference in words.
    """
    header, began = capture.header, capture.segments[0].identity
    if began is None:
        raise Differs(str(capture.path), ["it has no record of its set-up: an older version or an import"])
    mode = header.mode
    then_rig = parse_yaml(header.rig_yaml, RigConfig, source=f"{capture.path}: rig")
    then_plan = parse_yaml(header.plan_yaml, MeasurementPlan, source=f"{capture.path}: plan")
    then_model = parse_yaml(header.instrument_yaml, InstrumentModel, source=f"{capture.path}: instrument model")
    changes = [*differences(plain(then_plan), plain(plan), "plan")]
    if not changes:
        now = identity_of(plan, config, instrument, None)
        changes += differences(began.simulated, now.simulated, "simulated")
        changes += differences(rig_content(then_rig, mode), rig_content(config, mode), "rig")
        changes += differences(_optics(then_model), _optics(instrument), "instrument")
        changes += differences(began.files, now.files, "content of the file")
        changes += differences(began.software, now.software, "program")
    if changes:
        raise Differs(str(capture.path), changes)


def devices_of(rig: Rig) -> tuple[dict[str, Any], dict[str, Any]]:
    """What lasts of the devices of a rig, and the settings of its camera."""
    return device_properties(rig.describe()), rig.require_camera().settings.model_dump(mode="json")


def require_same_devices(capture: Capture, devices: dict[str, Any], settings: dict[str, Any]) -> None:
    """Refuse to go on with other devices, or a camera that is set otherwise (`devices_of`). Raises Differs."""
    began = capture.segments[0]
    then = began.identity.devices if began.identity is not None else {}
    changes = [*differences(then, devices, "device")]
    for key in CameraSettings.model_fields:
        if key not in PASSING:
            changes += differences(began.camera_settings.get(key), settings.get(key), f"camera setting.{key}")
    if changes:
        raise Differs(str(capture.path), changes)


def differences(then: Any, now: Any, key: str) -> Iterator[str]:
    """Where two trees of plain values differ, each in a line of words."""
    if isinstance(then, dict) and isinstance(now, dict):
        for name in [*then, *(name for name in now if name not in then)]:
            yield from differences(then.get(name), now.get(name), f"{key}.{name}")
    elif isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for number, (a, b) in enumerate(zip(then, now, strict=True)):
            yield from differences(a, b, f"{key}[{number}]")
    elif then != now:
        yield f"{key}: {_shorten(then)} at the start, {_shorten(now)} now"


def _shorten(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _strip_places(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {
            str(key): _strip_places(value)
            for key, value in tree.items()
            if key not in PLACES and not isinstance(value, Path)
        }
    return [_strip_places(value) for value in tree] if isinstance(tree, list | tuple) else tree


def _paths(tree: Any, key: str) -> Iterator[tuple[str, Path]]:
    if isinstance(tree, Path):
        yield key.lstrip("."), tree
    elif isinstance(tree, dict):
        for name, value in tree.items():
            yield from _paths(value, f"{key}.{name}")
