"""`acquire init`: a rig file to begin with, made of the cameras and serial ports that are there. Opens no port."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acquisition.commands.defaults import CONFIGS
from acquisition.rig.config import RigConfig
from drivers.errors import CameraError
from drivers.registry import Family, device_kinds
from processing.doors import one_line, read_text_of_any_system, require_new
from processing.errors import ProcessError
from processing.whole_file import write_new_text
from processing.yaml_file import parse_yaml

#: Kinds with these USB numbers (vendor, product); a plain FTDI chip (0403:6001) may be anything.
LIKELY = {(0x0403, 0xFAF0): "apt", (0x0403, 0x6015): "elliptec", (0x1CBE, 0x0007): "standa", (0x1313, 0x80C8): "dc2200"}
BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True)
class FoundPort:
    """A serial port: a path that stays when cables are moved, its description, and its probable kind."""

    path: str
    description: str
    kind: str | None


def find_ports() -> list[FoundPort]:
    """Serial ports of USB adapters, by their lasting names where there are."""
    from serial.tools.list_ports import comports

    lasting = {str(path.resolve()): str(path) for path in sorted(BY_ID.glob("*"))}
    return [
        FoundPort(
            lasting.get(str(Path(entry.device).resolve()), entry.device),
            f"{entry.description}, USB {entry.vid:04x}:{entry.pid:04x}",
            LIKELY.get((entry.vid, entry.pid)),
        )
        for entry in sorted(comports(), key=lambda entry: str(entry.device))
        if entry.vid is not None
    ]


def find_cameras() -> tuple[list[dict[str, str]], str]:
    """Cameras that answer, and why there are none where none can be looked for."""
    from drivers.aravis_library import list_cameras, load_aravis

    try:
        return list_cameras(load_aravis()[0]), ""
    except (CameraError, ImportError) as error:
        return [], " ".join(str(error).split())


def configured_devices(configuration: Path) -> list[tuple[str, str]]:
    """Label and adapter of every device in a configuration of Micro-Manager, which is read and not loaded.

    Raises ProcessError: it cannot be read, or has no device.
    """
    lines = [line.strip().split(",") for line in read_text_of_any_system(configuration).splitlines()]
    devices = [(words[1], " ".join(words[2:])) for words in lines if words[0] == "Device" and len(words) == 4]
    if not devices:
        raise ProcessError(f"{configuration}: it has no line `Device,LABEL,ADAPTER,NAME`. Save it in Micro-Manager")
    return devices


def _from_core(configuration: Path | None) -> list[str]:
    """How a device of a core of Micro-Manager would be written as an axis or as the camera, as comments."""
    if configuration is None:
        return []
    path = one_line(configuration.absolute())
    return [
        f"# In {one_line(configuration.name)}; a stage is an axis, a camera the camera:",
        *(f"#  {one_line(label)}: {one_line(adapter)}" for label, adapter in configured_devices(configuration)),
        f"#  NAME: {{kind: mmcore, device: LABEL, configuration: {path}, speed_deg_s: ...}}",
        f"#  camera: {{kind: mmcore, device: LABEL, configuration: {path}}}",
    ]


def rig_text(
    name: str,
    cameras: Sequence[dict[str, str]],
    ports: Iterable[FoundPort],
    *,
    why_no_camera: str = "",
    configuration: Path | None = None,
) -> str:
    """A rig file as text: what was found, what can be chosen, and what only a person knows, each with a comment.

    Raises ConfigError: the text is no rig file, which would be a mistake of this program.
    """
    ports = list(ports)
    axes = [port for port in ports if port.kind is None or port.kind in device_kinds("axes")]
    lines = [
        f"# yaml-language-server: $schema={CONFIGS / 'schemas' / 'rig.schema.json'}",
        "# Made by `acquire init` of what answered. Look at every line: then `acquire doctor --rig THIS_FILE`.",
        "kind: rig",
        f"name: {name}",
        "",
        "# The axes that turn; names as in the instrument file below (psg, psa), `arm` sets Omega. Kinds:",
        *_kinds("axes"),
        "# Replace {} by the axes; each also takes zero_deg, direction, limits_deg, ...",
        "axes: {}",
        *(line for port in axes for line in _axis(port)),
        *([] if axes else ["#  no serial port of a USB adapter was found"]),
        *_from_core(configuration),
        "",
        *_camera(cameras, why_no_camera),
        "",
        "# The light: manual asks a person to switch it for dark states. Kinds:",
        *_kinds("sources"),
        "source: {kind: manual}",
        *(f"# source: {{kind: {p.kind}, port: {p.path}}}" for p in ports if p.kind in device_kinds("sources")),
        "",
        "# Constants of the sensor; gain and noise give the error bars: `process camera` measures them.",
        "detector: {black_level_counts: 0, bits: 12}",
        "wavelengths_nm: [662]",
        "",
        "# Each measuring mode with its instrument; other files: configs/instruments/",
        "modes:",
        "  drr:",
        f"    instrument: {CONFIGS / 'instruments' / 'rgb950.yaml'}",
        "",
        "# What a run may never do. Fill this in before anything moves (docs/acquisition.md).",
        "# home_order: [arm, psg, psa]",
        "# park_deg: {arm: 90}",
        "# forbidden:",
        "#   - {why: the camera would stand in the source's light, ranges_deg: {arm: [-10, 5]}}",
        "# interlocks:",
        "#   - {kind: door}",
        "# notify: {command: [/path/to/command]}",
    ]
    text = "\n".join(lines) + "\n"
    parse_yaml(text, RigConfig, "the new rig file")
    return text


def _kinds(family: Family) -> list[str]:
    """A comment for each kind of device."""
    return [f"#   {kind}: {(module.__doc__ or '').splitlines()[0]}" for kind, module in device_kinds(family).items()]


def _axis(port: FoundPort) -> list[str]:
    """How an axis at a port would be written, as comments."""
    kind = port.kind or "KIND"
    config: Any = device_kinds("axes")[port.kind].Config if port.kind else None
    more = [name for name, field in config.model_fields.items() if field.is_required()] if config else []
    keys = "".join(f", {name}: ..." for name in more if name != "port")
    guess = f"probably {port.kind}" if port.kind else "which controller?"
    return [f"#  {port.description}: {guess}", f"#  NAME: {{kind: {kind}, port: {port.path}{keys}}}"]


def _camera(cameras: Sequence[dict[str, str]], why_none: str) -> list[str]:
    if not cameras:
        return [
            f"# No camera answered{f' ({why_none})' if why_none else ''}. `device` is its serial number or address.",
            "camera: {kind: aravis, bits: 12}",
        ]
    lines = ["# Cameras that answered; the first is taken. On gigabit links packet_size 9000 needs jumbo frames."]
    for number, camera in enumerate(cameras):
        summary = " ".join(filter(None, (camera["vendor"], camera["model"], "at", camera["address"])))
        entry = f"camera: {{kind: aravis, device: {camera['serial_number']!r}, bits: 12}}"
        lines += [f"# {summary}", entry if number == 0 else f"# {entry}"]
    return lines


def write_rig(path: Path, configuration: Path | None = None) -> str:
    """Look for devices, also in a configuration of Micro-Manager, write the file, report the devices.

    Raises ProcessError: a file of that name exists, there is no such folder, or the configuration cannot be read.
    """
    require_new(path)
    (cameras, why), ports = find_cameras(), find_ports()
    text = rig_text(path.stem, cameras, ports, why_no_camera=why, configuration=configuration)
    write_new_text(path, text)
    return f"{path}: {len(cameras)} camera(s), {len(ports)} serial port(s). Fill in the axes, then acquire doctor --rig"
