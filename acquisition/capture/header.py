"""Header, title and file name of a capture, which are known before its first state."""

import datetime
import functools
import json
import platform
import re

from acquisition.capture.mosaic_phase import colours_of
from acquisition.capture.plan import MeasurementPlan
from acquisition.rig.config import RigConfig
from acquisition.rig.rig import Rig
from processing.instrument.model import InstrumentModel
from processing.storage.captures.schema import CaptureHeader
from processing.yaml_file import dump_yaml


def capture_header(plan: MeasurementPlan, config: RigConfig, instrument: InstrumentModel, rig: Rig) -> CaptureHeader:
    """The header of a capture that is about to start, with settings and devices as read back."""
    camera = rig.require_camera()
    mosaic = instrument.mosaic
    return CaptureHeader(
        title=title_of(plan),
        simulated=config.simulated,
        mode=plan.mode,
        wavelength_nm=plan.wavelength_nm,
        omega_deg=plan.omega_deg,
        illumination=_illumination(instrument),
        sample=plan.sample,
        detector=config.detector.model_copy(update={"bits": camera.bits}),
        channels=("mosaic",) if mosaic else ("beams",) if instrument.beams else (instrument.channels[0].name,),
        mosaic=mosaic,
        beams=instrument.beams,
        instrument_yaml=dump_yaml(instrument),
        plan_yaml=dump_yaml(plan),
        rig_yaml=dump_yaml(config),
        camera_settings_json=camera.settings.model_dump_json(),
        devices_json=json.dumps(rig.describe(), default=str),
        versions=versions(),
        seed=config.seed,
        folded_deg=dict(config.fold_deg),
        voltages={axis: dict(entry.named_states()) for axis, entry in config.axes.items() if entry.unit == "V"},
        camera_nodes=camera.node_map(),
        colours=colours_of(instrument, camera),
    )


def _illumination(instrument: InstrumentModel) -> str | None:
    """Horizontal or vertical, where the generator stands still and makes one of the two."""
    if any(element.axis for element in instrument.generator):
        return None
    s = instrument.generator_states({"none": [0.0]})[0]
    if abs(s[1]) < 0.99 * s[0]:
        return None
    return "horizontal" if s[1] > 0 else "vertical"


@functools.cache
def versions() -> dict[str, str]:
    """Versions of what made the file."""
    from importlib.metadata import version

    import h5py

    names = ("umov", "numpy", "h5py", "pyserial", "pydantic")
    by_package = {name: version(name) for name in names}
    return by_package | {"hdf5": h5py.version.hdf5_version, "python": platform.python_version()}


def default_name(plan: MeasurementPlan) -> str:
    """File name of a capture: date, time, sample, mode, wavelength, Omega."""
    sample = re.sub(r"[^A-Za-z0-9]+", "_", plan.sample.name or plan.sample.kind).strip("_")
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return f"{stamp}_{sample}_{plan.mode}_{plan.wavelength_nm:g}nm_omega{plan.omega_deg:g}.h5"


def title_of(plan: MeasurementPlan) -> str:
    """The plan's title, or one made of what it measures."""
    sample = plan.sample.name or plan.sample.kind
    return plan.title or f"{sample}, {plan.mode}, {plan.wavelength_nm:g} nm, Omega {plan.omega_deg:g} deg"


def now() -> str:
    """Time with its zone, ISO 8601."""
    return datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
