"""A whole capture file straight from the simulated bench, without drivers or motors: for virtual experiments."""

from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from processing.instrument.model import InstrumentModel
from processing.instrument.states import RGB950_RATIO, RGB950_STATES, RGB950_STEP_DEG
from processing.storage.captures.schema import CaptureHeader, Sample, create_layout, write_closing
from processing.storage.integrity.checksums import row_crc32, write_checksums
from processing.yaml_file import dump_yaml
from simulators.bench.bench import SimulatedBench


def write_virtual_capture(
    path: Path,
    bench: SimulatedBench,
    instrument: InstrumentModel,
    omega_deg: float,
    *,
    exposure_s: float = 0.02,
    states: int = RGB950_STATES,
    darks: int = 4,
    name: str = "virtual",
) -> None:
    """Take `darks` dark states and `states` states of the sample, and write them as a simulated capture.

    Parameters
    ----------
    path : Path
    bench : SimulatedBench
        With its scene, true optics and wavelength.
    instrument : InstrumentModel
        The model declared in the file, all wavelengths; with a mosaic, all states are equal.
    omega_deg : float
        Angle of the arm.
    exposure_s : float
        Of every state, seconds.
    states, darks : int
    name : str
        Of the sample.

    Raises
    ------
    ValueError
        The instrument turns other axes than psg and psa.

    Examples
    --------
    >>> from acquisition import Scene, SimulatedBench, write_virtual_capture
    >>> declared = InstrumentModel.load("instrument.yaml")
    >>> bench = SimulatedBench(Scene.load("scenes/air.yaml"), declared, 662, rows=24, columns=32)
    >>> write_virtual_capture(Path("virtual.h5"), bench, declared, omega_deg=180)
    >>> len(Capture("virtual.h5").role)
    44
    """
    axes = instrument.axes
    psg = RGB950_STEP_DEG * np.arange(states)
    pose_of_axis = {"psg": psg, "psa": RGB950_RATIO * psg}
    unknown = [axis for axis in axes if axis not in pose_of_axis]
    if unknown:
        raise ValueError(f"virtual captures turn psg and psa only; the instrument has {', '.join(unknown)}")
    angles = {axis: np.concatenate([np.zeros(darks), pose_of_axis[axis]]) for axis in axes}
    header = CaptureHeader(
        title=f"{name} {bench.wavelength_nm:g} nm omega {omega_deg:g}",
        simulated=True,
        mode="stokes" if instrument.mosaic else "drr",
        wavelength_nm=bench.wavelength_nm,
        omega_deg=omega_deg,
        sample=Sample(name=name),
        detector=bench.detector,
        mosaic=instrument.mosaic,
        instrument_yaml=dump_yaml(instrument),
        seed=bench.seed,
    )
    role = ("dark",) * darks + ("sample",) * states
    now = datetime.now(UTC).isoformat(timespec="seconds")
    with h5py.File(path, "w") as h5:
        create_layout(
            h5, header, angles, role, frame_shape=(bench.rows, bench.columns), dtype=np.uint16, start_time=now
        )
        frames = h5["entry/instrument/detector/data"]
        for k in range(len(role)):
            pose = {axis: float(values[k]) for axis, values in angles.items()}
            frames[k, 0] = bench.expose(pose, exposure_s, k, light=k >= darks, omega_deg=omega_deg)
            for axis in axes:
                h5[f"entry/instrument/{axis}/value"][k] = angles[axis][k]
        h5["entry/states/exposure_s"][...] = exposure_s
        if "repeats" in h5["entry/states"]:
            h5["entry/states/repeats"][...] = 1
        h5["entry/states/done"][...] = 1
        write_checksums(h5["entry"], row_crc32(frames[...]))
        write_closing(h5, "complete", {})
