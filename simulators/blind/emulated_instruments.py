"""Every instrument of configs/ on an emulated bench: wrong by what its file does not say."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.storage.captures.schema import Detector
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture

Array = NDArray[np.floating]

INSTRUMENTS = Path(__file__).resolve().parents[2] / "configs/instruments"
#: Another sample: a turned plate of 100 degrees behind a weak diattenuator, half of it depolarized.
SAMPLE = 0.7 * mueller.retarder(0.4, 1.75) @ mueller.diattenuator(0.9, 1.0, 0.7) + 0.3 * mueller.IDEAL_DEPOLARIZER
NOISE, COUNTS, BLACK, READ = 1e-3, 20_000.0, 100, 3.0


@dataclass(frozen=True)
class Bench:
    """An instrument as it is: angles of its axes, and by how much values of its train differ from its file.

    Attributes
    ----------
    flicker : standard deviation of the level of the source over the states.
    """

    angles_deg: dict[str, Array]
    wrong: dict[str, float]
    flicker: float = 0.0
    nm: float = 662.0
    leave_out: tuple[str, ...] = ()


_N = np.arange
BENCHES = {
    "rgb950": Bench(
        {"psg": 9.0 * _N(40), "psa": 4.91 * 9.0 * _N(40)},
        {"psg_retarder.azimuth_deg": 0.6, "psa_retarder.retardance_deg": 1.5},
    ),
    "drr_5to1": Bench(
        {"psg": 6.0 * _N(61), "psa": 30.0 * _N(61)}, {"psg_retarder.retardance_deg": 2.0, "analyzer.azimuth_deg": 0.4}
    ),
    "drr_single_detector": Bench(
        {"psg": 6.0 * _N(61), "psa": 30.0 * _N(61)},
        {"psg_retarder.azimuth_deg": 7.0, "psa_retarder.azimuth_deg": -4.0, "psa_retarder.retardance_deg": 6.0},
    ),
    "drr_imaging_630nm": Bench(
        {
            "psg": np.tile(np.repeat(22.5 * _N(8), 8), 2),
            "psa": np.tile(22.5 * _N(8), 16),
            "analyzer": np.repeat([0.0, 45.0], 64),
        },
        {"psg_retarder.azimuth_deg": 12.0, "psg_retarder.retardance_deg": -5.0, "psa_retarder.azimuth_deg": 5.0},
        nm=630.0,
    ),
    "drr_wollaston": Bench(
        {"psg": 4.0 * _N(46)},
        {
            "psg_retarder.azimuth_deg": 5.0,
            "psa_retarder.azimuth_deg": -7.0,
            "psa_retarder.retardance_deg": 4.0,
            "wollaston_right.extinction": 0.01,
            "right.gain": 0.04,
        },
        flicker=0.03,
    ),
    "dual_beam_charis": Bench(
        {"hwp": np.repeat(11.25 * _N(8), 8), "image_rotator": np.tile(45 + 12.5 * _N(8), 8)},
        {
            "source_polarizer.azimuth_deg": 3.0,
            "half_wave_plate.azimuth_deg": -2.0,
            "half_wave_plate.retardance_deg": -9.0,
            "image_rotator.retardance_deg": -60.0,
        },
        flicker=0.03,
        leave_out=("image_rotator.depolarization", "half_wave_plate.depolarization"),
    ),
    "mosaic_polarimeter": Bench(
        {"psg": 9.0 * _N(40)}, {"psg_retarder.azimuth_deg": 0.8, "psg_retarder.retardance_deg": 1.5}, flicker=0.03
    ),
    "polarization_camera_retarder": Bench(
        {"psa": 9.0 * _N(40)}, {"psa_retarder.azimuth_deg": 0.8, "45.gain": 0.03}, flicker=0.03
    ),
    "linear_stokes": Bench({}, {"45.gain": 0.03, "90.gain": -0.02}),
    "linear_mueller": Bench(
        {"psg": np.repeat(20.0 * _N(9), 9), "psa": np.tile(20.0 * _N(9), 9)}, {"analyzer.azimuth_deg": 0.8}
    ),
    "rotating_analyzer": Bench({"psa": 10.0 * _N(36)}, {"analyzer.extinction": 0.02}),
    "rotating_retarder_stokes": Bench({"psa": 10.0 * _N(36)}, {"psa_retarder.retardance_deg": 2.0}),
}


#: Angles of the axes as they were, and the level of the source (states,), of a capture with a fault.
Wrong = tuple[dict[str, Array], Array]


def _slips(bench: Bench, random: np.random.Generator) -> Wrong:
    angles, level = _right(bench)
    for _ in range(2):
        first, axis = random.integers(3, len(level) - 3), list(angles)[random.integers(len(angles))]
        angles[axis][first:] += random.uniform(0.3, 2) * random.choice([-1, 1])
    return angles, level


def _smooth_source(bench: Bench, random: np.random.Generator) -> Wrong:
    angles, level = _right(bench)
    turn = 2 * np.pi * np.arange(len(level)) / len(level)
    wave = 0.02 * np.cos(2 * turn * random.integers(1, 4) + random.uniform(0, 6))
    return angles, level + wave + 0.01 * np.cos(turn + random.uniform(0, 6))


def _angles(bench: Bench, random: np.random.Generator) -> Wrong:
    angles, level = _right(bench)
    return {axis: a + random.normal(0, 0.2, a.size) for axis, a in angles.items()}, level


def _right(bench: Bench) -> Wrong:
    angles = {axis: np.array(a, dtype=float) for axis, a in bench.angles_deg.items()}
    return angles, np.ones(len(next(iter(angles.values()))))


#: Faults of the capture of air alone: their effect must not reach another sample.
OF_AIR = {"slips": _slips, "source": _smooth_source, "angles": _angles}


def emulated_capture(
    model: InstrumentModel,
    bench: Bench,
    sample: Array,
    kind: str,
    *,
    file: Path,
    random: np.random.Generator,
    wrong: Wrong | None = None,
) -> Path:
    """An imported capture: fluxes, or frames of 48 x 48 pixels of a camera with a mosaic."""
    states = max((len(a) for a in bench.angles_deg.values()), default=4)
    angles = bench.angles_deg or {"": np.zeros(states)}
    level = 1 + bench.flicker * random.standard_normal((states, 1))
    as_they_were, extra = wrong or (angles, np.ones(states))
    level = level * extra[:, None]
    light = np.broadcast_to(model.rows(as_they_were), (states, len(model.channels), 16)) @ sample.reshape(16) * level
    table = {f"{axis}_deg": a for axis, a in bench.angles_deg.items()}
    stem = file.with_name(f"{file.stem}_{kind}")
    stack = None
    if model.mosaic is None:
        counts = COUNTS * (light + NOISE * random.standard_normal(light.shape))
        table |= {f"channel_{c.name}": counts[:, k] for k, c in enumerate(model.channels)}
    else:
        names = [c.name for c in model.channels]
        frames = np.empty((states, 48, 48))
        for (r, c), channel in np.ndenumerate(np.array(model.mosaic)):
            frames[:, r::2, c::2] = light[:, names.index(channel)][:, None, None]
        stack = str(stem.with_suffix(".npy"))
        counts = random.poisson(COUNTS * frames) + random.normal(BLACK, READ, frames.shape)
        np.save(stack, np.round(counts).astype(np.uint16))
    lines = [",".join(["state", *table])]
    lines += [",".join([str(n), *(repr(float(column[n])) for column in table.values())]) for n in range(states)]
    stem.with_suffix(".csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    request = ImportRequest(
        states=stem.with_suffix(".csv"),
        stack=stack,
        out=stem.with_suffix(".h5"),
        wavelength_nm=bench.nm,
        instrument=file,
        sample=read_sample(kind),
        detector=Detector(black_level_counts=BLACK, gain_e_per_count=1.0, read_noise_e=READ) if stack else Detector(),
    )
    import_capture(request)
    return request.out
