"""`acquire doctor`: which devices are present, and why others are not. Moves nothing, changes no light."""

import importlib
import shutil
import sys
import sysconfig
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from acquisition.capture.header import versions
from acquisition.capture.machine_checks import check_machine
from acquisition.cleanup import run_all
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig
from drivers.camera import Camera, CameraIdentity, CameraSettings
from drivers.errors import DeviceError, FrameLost
from drivers.motion import MotionAxis
from drivers.sources.manual import ManualSource
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel

#: Frames of the packet-loss test, and their exposure.
FRAMES = 50
EXPOSURE_S = 0.001
#: Packet with its headers that gigabit links with jumbo frames carry, bytes.
JUMBO_BYTES = 9000


@dataclass(frozen=True)
class Finding:
    """One line of a report. `well` is None for plain information."""

    title: str
    well: bool | None
    detail: str

    @property
    def row(self) -> tuple[str, str, str]:
        """The columns of the report: ok, BAD or nothing, then title and detail."""
        return {True: "ok", False: "BAD", None: ""}[self.well], self.title, self.detail


def examine(config: RigConfig, folder: Path, frames: int = FRAMES) -> Iterator[Finding]:
    """Look at everything that a measurement needs, one finding after another; no device's failure hides another's."""
    yield Finding("versions", None, ", ".join(f"{name} {number}" for name, number in versions().items()))
    yield Finding("umov", None, f"{Path(__file__).parents[2]}, run by {sys.executable}")
    for name in ("numpy", "h5py"):
        yield _guarded(name, lambda name=name: _origin(name))  # type: ignore[misc]
    yield _guarded("aravis", _aravis)
    free = shutil.disk_usage(folder).free
    yield Finding("disc", free > 1e9, f"{free / 1e9:.1f} GB free in {folder.resolve()}")
    for name, mode in config.modes.items():
        yield _guarded(f"mode {name}", lambda mode=mode: _instrument(mode.instrument))  # type: ignore[misc]
    for check in check_machine(config):
        yield Finding(check.title, check.passed, check.detail)
    rig = open_rig(config)
    try:
        yield _guarded("rig", rig.start)
        for name in config.axes:
            yield _guarded(f"axis {name}", lambda name=name: describe_axis(rig.open_axis(name)))  # type: ignore[misc]
        if config.source is not None:
            yield _guarded("source", lambda: describe_source(rig))
        yield _guarded("camera", lambda: _camera(rig.open_camera(), config, frames))
    finally:
        failure = run_all([("close the rig", rig.close)])
    if failure is not None:
        yield Finding("closing", False, str(failure))


def _guarded(title: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(title, True, look())
    except (DeviceError, AcquisitionError, ProcessError, ImportError, ValueError) as error:
        return Finding(title, False, str(error))


def _origin(name: str) -> str:
    """Where a package is imported from; it must be this environment, not the system that gi is borrowed from."""
    folder = Path(str(importlib.import_module(name).__file__)).parent
    folders = {Path(sysconfig.get_path(part)) for part in ("purelib", "platlib")}
    if not any(folder.is_relative_to(place) for place in folders):
        raise AcquisitionError(
            f"it comes from {folder}, not from this environment. Unset PYTHONPATH; run ./lab, which shows only gi to it"
        )
    return str(folder)


def _aravis() -> str:
    from drivers.aravis_library import load_aravis

    aravis, _ = load_aravis()
    # The library itself is loaded with the first call.
    aravis.get_n_interfaces()
    import gi

    # The bindings tell the version of the interface only; the file name of the library has all of it.
    mapped = (line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "libaravis" in line)
    library = next(mapped, "its library is not to be seen")
    return f"{Path(library).resolve()}; gi {gi.__version__} in {Path(str(gi.__file__)).resolve().parent}"


def _instrument(path: Path) -> str:
    model = InstrumentModel.load(path)
    return f"{model.name} ({path.name})"


def describe_axis(axis: MotionAxis) -> str:
    """An axis in a line: identity, position, limits, speed and warnings. Raises DeviceError."""
    identity = axis.describe()
    limits = axis.limits
    ends = "limits " + " to ".join("none" if end is None else f"{end:g}" for end in (limits.min_deg, limits.max_deg))
    if limits.min_deg is None and limits.max_deg is None:
        ends = "no limits"
    axis.check_fault()
    homed = "homed" if axis.is_homed() else "NOT homed"
    moving = ", MOVING" if axis.is_moving() else ""
    position = f"at {axis.read_position().deg:.4f} {axis.config.unit}, " if axis.is_homed() else ""
    warnings = "".join(f", warning: {text}" for text in axis.warnings())
    stop = "" if axis.can_stop_a_move else ", cannot be stopped once it moves"
    name = f"{identity.kind} {identity.model}, serial {identity.serial_number}, firmware {identity.firmware}"
    if axis.config.unit == "V":
        return f"{name}, {identity.port}: {position}{ends}{warnings}"
    # As `process design --speed` wants it.
    speed = f"{axis.speed_deg_s:.4g}:{axis.acceleration_deg_s2:.4g} deg/s:deg/s2"
    return f"{name}, {identity.port}: {homed}{moving}, {position}{ends}, speed {speed}{stop}{warnings}"


def describe_source(rig: Rig) -> str:
    """The light source in a line; a light that is already on is an error."""
    source = rig.open_source()
    state = "light on" if source.is_on() else "light off"
    facts = source.describe()
    name = ", ".join(f"{key.replace('_', ' ')} {facts[key]}" for key in facts if key != "model")
    if source.is_on() and not isinstance(source.inner, ManualSource):
        raise AcquisitionError(f"{facts['model']}, {name}: LIGHT LEFT ON. Every run ends with the light off: shut it")
    if source.interlock_open():
        raise AcquisitionError(f"{facts['model']}, {name}: {state}, INTERLOCK OPEN. Close the door")
    return f"{facts['model']}, {name}: {state}, interlock closed"


def _camera(camera: Camera, config: RigConfig, frames: int) -> str:
    """Take frames and count those that were lost; the dark ones of a shut source serve as well."""
    exposure_s = max(EXPOSURE_S, config.exposure_s[0])
    # By software, also if captures use a hardware trigger: nothing fires one here.
    camera.configure(CameraSettings(exposure_s=exposure_s, frame_average=1, trigger="software"))
    identity = camera.describe()
    lost = 0
    for _ in range(frames):
        try:
            camera.trigger().frame()
        except FrameLost:
            lost += 1
    statistics = camera.statistics()
    temperature = camera.temperature_c()
    warm = "" if temperature is None else f", {temperature:.1f} C"
    report = (
        f"{identity.library}: {identity.vendor} {identity.model}, serial {identity.serial_number}, "
        f"{identity.sensor_width} x {identity.sensor_height} {identity.pixel_format} ({identity.bits} bits), "
        f"{_packets(identity)}{warm}; "
        f"{lost} of {frames} frames lost, {statistics.missing_packets} packets missing, "
        f"{statistics.resent_packets} resent; counts in steps of {camera.top_of_counts.step} up to {camera.full_scale}"
        + "".join(f"; NOT IN A KNOWN STATE: {text}" for text in camera.warnings())
    )
    if lost:
        raise AcquisitionError(report + ". " + _loss_advice(identity))
    if config.detector.bits is not None and camera.bits != config.detector.bits:
        raise AcquisitionError(
            f"{report}. The rig file says {config.detector.bits} bits under `detector`; correct that or `camera`"
        )
    return report


def _loss_advice(who: CameraIdentity) -> str:
    """What to change, with the numbers that are set now."""
    if who.packet_size is None:
        return "Check the cable, and that nothing else loads the USB controller."
    advice = ["Check the cable"]
    if who.interface_mtu is not None and who.packet_size < min(who.interface_mtu, JUMBO_BYTES):
        largest = min(who.interface_mtu, JUMBO_BYTES)
        advice.append(f"set packet_size to {largest}, which {who.interface} takes, if the switch does too")
    elif who.interface_mtu is not None and who.interface_mtu < JUMBO_BYTES:
        advice.append(f"raise the MTU of {who.interface} from {who.interface_mtu} to {JUMBO_BYTES}, then packet_size")
    if not who.resend:
        advice.append("set `resend: true`")
    if who.packet_delay is not None:
        pause = max(1000, 2 * who.packet_delay)
        advice.append(f"raise the pause between packets, `features: {{GevSCPD: {pause}}}`, where links are shared")
    return "; ".join(advice) + "."


def _packets(who: CameraIdentity) -> str:
    if who.packet_size is None:
        return "not on Ethernet"
    pause = "not told" if who.packet_delay is None else f"{who.packet_delay} ticks"
    return (
        f"at {who.address}, packets of {who.packet_size} bytes, {who.interface} takes up to {who.interface_mtu}, "
        f"pause between packets {pause} (GevSCPD), lost packets {'' if who.resend else 'not '}asked for again"
    )
