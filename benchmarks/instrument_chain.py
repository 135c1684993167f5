"""From a capture of a known sample to the Mueller matrix of another sample, for every instrument in configs/.

Each instrument is wrong by what its file does not say. One capture of air is diagnosed, the file is written, and a
capture of another sample is reduced with the nominal and with the written file. The references are no part of any fit:
the emulated sample, or the ratio of the channels of measured data.

    python benchmarks/instrument_chain.py             prints the table of docs/studies/instrument-chain.md
    python benchmarks/instrument_chain.py --starts    five instruments, each from nominal files 40 to 260 degrees apart
    python benchmarks/instrument_chain.py --draws     measured data, the model from 36 of the 46 states of air
    python benchmarks/instrument_chain.py --air       faults of the capture of air alone
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import WriteError, write_instrument
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.public_data.conversion import PublicStates, mirror_means, tables_of
from processing.public_data.sets import SHIPPED, find_files
from processing.steps.reduction import Reduction
from processing.storage.captures.schema import Detector
from processing.storage.formats.importing import ImportRequest, import_capture, read_sample
from processing.storage.products.product import Product
from processing.yaml_file import dump_yaml

Array = NDArray[np.float64]

INSTRUMENTS = Path(__file__).resolve().parents[1] / "configs/instruments"
#: Another sample: a turned plate of 100 degrees behind a weak diattenuator, half of it depolarized.
SAMPLE = 0.7 * mueller.retarder(0.4, 1.75) @ mueller.diattenuator(0.9, 1.0, 0.7) + 0.3 * mueller.IDEAL_DEPOLARIZER
#: Where public measured data are that may not be in the tree.
DATA = Path(os.environ.get("UMOV_DATA", INSTRUMENTS.parents[2] / "shared" / "data"))
MEASURED_NM, KINDS = (1200, 1300, 1600, 1950), ("air", "plate")
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


@dataclass(frozen=True)
class Row:
    """What became of another sample.

    Attributes
    ----------
    nominal, train, written : rms difference from the reference, over the elements of M/m00 (S/S0) that the instrument
        determines, reduced with the file as it was, with the fitted values of the train alone, and as it was written.
    stated : rms of the standard errors in the product, noise and systematic.
    reference : what it is compared with.
    """

    name: str
    nominal: float
    train: float
    written: float
    stated: float
    verdict: str
    reference: str

    @property
    def line(self) -> str:
        """A line of the table."""
        figures = f"{self.nominal:.4f} | {self.train:.4f} | {self.written:.4f} | {self.stated:.4f}"
        return f"| {self.name} | {self.reference} | {figures} | {self.verdict.replace('_', ' ')} |"


def emulated(
    name: str, folder: Path, seed: int = 1, fault: Callable[[Bench, np.random.Generator], Wrong] | None = None
) -> Row:
    """The chain of one instrument of configs/instruments on an emulated bench, with a `fault` of air alone."""
    bench, file = BENCHES[name], folder / f"{name}.yaml"
    text = (INSTRUMENTS / f"{name}.yaml").read_text(encoding="utf-8")
    for value in bench.leave_out:
        text = "".join(line for line in text.splitlines(True) if value not in line)
    file.write_text(text, encoding="utf-8")
    nominal = InstrumentModel.load(file)
    true = nominal.at(bench.nm)
    for value, by in bench.wrong.items():
        place, _, field = value.rpartition(".")
        true = true.with_values({place: {field: float(true.value_of(value) or 0.0) + by}})  # type: ignore[arg-type]
    random = np.random.default_rng(seed)
    air = emulated_capture(
        true,
        bench,
        np.eye(4),
        "air",
        file=file,
        random=random,
        wrong=fault(bench, np.random.default_rng(seed)) if fault else None,
    )
    other = emulated_capture(true, bench, SAMPLE, "unknown", file=file, random=random)

    def truth(product: dict[str, Array]) -> Array:
        if "stokes" not in product:
            return SAMPLE / SAMPLE[0, 0]
        sent = SAMPLE @ true.generator_states({})[0]
        return np.asarray(sent / sent[0])

    return chain(name, air, other, file, truth=truth, reference="the emulated sample")


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


#: Faults of the capture of air alone: what they change must not reach another sample.
OF_AIR = {"slips": _slips, "source": _smooth_source, "angles": _angles}


def chain(
    name: str, air: Path, other: Path, file: Path, *, truth: Callable[[dict[str, Array]], Array], reference: str
) -> Row:
    """Diagnose a capture, write, and reduce another with both files."""
    model = InstrumentModel.load(file)
    found = diagnose_captures([air], model)[0].diagnosis
    new = file.with_name(f"{file.stem}.new.yaml")
    try:
        write_instrument(new, model, found)
    except WriteError:
        new = file
    train = file.with_name(f"{file.stem}.train.yaml")
    train.write_text(dump_yaml(InstrumentModel.load(new).model_copy(update={"effects": (), "systematic": ()})))
    errors = []
    for k, used in enumerate((file, train, new)):
        product = _product(Reduction(other, used).make(other.with_suffix(f".{k}.h5"), True))
        values, stated = _relative(product)
        wanted = truth(product).reshape(values.shape)
        seen = np.isfinite(values) & (np.arange(values.size) > 0)
        errors.append((_rms(values[seen] - wanted[seen]), _rms(stated[seen])))
    (nominal, _), (alone, _), (written, stated) = errors
    return Row(name, nominal, alone, written, stated, found.verdict, reference)


def half_wave_plate(nm: int, files: Mapping[str, Path], folder: Path, draw: int = 0) -> Row:
    """The chain on measured data: air, then a half-wave plate, against the ratio of the two channels.

    Of another `draw` than 0 the chain sees 36 of the 46 states of air.
    """
    air, plate = (
        next(t for t in tables_of("drr-wollaston-nir", files) if t.name == f"{kind}_{nm}nm") for kind in KINDS
    )
    reference = ratio_of_channels(
        *(np.array([row.split(",")[1:] for row in t.rows], dtype=float) for t in (air, plate))
    )
    flip = np.diag([1.0, 1.0, 1.0, -1.0])

    def truth(product: dict[str, Array]) -> Array:
        # Air leaves the sign of row and column 3 open.
        m = product["mueller"] / product["mueller"][0, 0]
        return min((reference, flip @ reference @ flip), key=lambda one: _rms(one - m))

    if draw:
        kept = sorted(np.random.default_rng(draw).choice(len(air.rows), len(air.rows) - 10, replace=False))
        air = replace(air, rows=tuple(f"{n},{air.rows[k].partition(',')[2]}" for n, k in enumerate(kept)))
    return _measured("drr_wollaston", (air, plate), folder, truth, reference="the ratio of the channels")


def mirror_frames(folder: Path) -> Row:
    """The chain on measured data: a mirror with one turn of the analyzer, then with the next, as an unknown sample."""
    table = mirror_means(SHIPPED / "drr-imaging-630nm/roi_stats_630nm.csv")
    half = len(table.rows) // 2
    first = replace(table, name="first_turn", rows=table.rows[:half])
    second = replace(table, name="second_turn", sample="unknown", rows=table.rows[half:])
    mirror = np.diag([1.0, 1.0, -1.0, -1.0])
    return _measured("drr_imaging_630nm", (first, second), folder, lambda product: mirror, reference="a mirror")


def _measured(
    instrument: str,
    tables: tuple[PublicStates, PublicStates],
    folder: Path,
    truth: Callable[[dict[str, Array]], Array],
    *,
    reference: str,
) -> Row:
    """The chain on two captures of public data, the known sample first."""
    nm = tables[0].wavelength_nm
    file = folder / f"{instrument}_{nm:g}.yaml"
    file.write_text((INSTRUMENTS / f"{instrument}.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    paths = []
    for table in tables:
        request = ImportRequest(
            states=table.write(folder)[0],
            out=folder / f"{table.name}.h5",
            wavelength_nm=nm,
            instrument=file,
            sample=read_sample(table.sample),
        )
        import_capture(request)
        paths.append(request.out)
    first, second = paths
    return chain(f"{instrument}, measured at {nm:g} nm", first, second, file, truth=truth, reference=reference)


def ratio_of_channels(air: Array, plate: Array) -> Array:
    """M/m00 of a plate from (left - right)/(left + right) alone, tables (N, 3) of angle in degrees, left and right.

    A train of its own: two retarders, elliptical light, and azimuth, extinction and gain of the channels.
    """
    random = np.random.default_rng(0)

    def rows(x: Array, theta_deg: Array) -> Array:
        t = np.deg2rad(theta_deg)
        sent = mueller.retarder(np.deg2rad(45.0), x[9]) @ mueller.polarizer(0.0, 0.0)[:, :1]
        g = (mueller.retarder(t + x[0], x[1]) @ sent)[..., 0]
        plate = mueller.retarder(5 * t + x[2], x[3])
        a = np.stack(
            [mueller.polarizer(x[4], x[6])[0] @ plate, x[8] * mueller.polarizer(x[5], x[7])[0] @ plate], axis=1
        )
        return np.asarray((a[..., :, None] * g[:, None, None, :]).reshape(len(t), 2, 16))

    def misfit(x: Array) -> Array:
        light = rows(x, air[:, 0]) @ np.eye(4).reshape(16)
        return np.asarray((light @ [1, -1]) / light.sum(axis=1) - (air[:, 1:] @ [1, -1]) / air[:, 1:].sum(axis=1))

    fits = []
    for k in range(24):
        azimuths = random.uniform(-np.pi / 2, np.pi / 2, 2)
        crossed = np.pi / 2 * (k % 2)
        start = [azimuths[0], 1.57, azimuths[1], 1.57, crossed, crossed + np.pi / 2, 0.002, 0.002, 1.0, 0.0]
        low = [-9, 0.8, -9, 0.8, -9, -9, 0, 0, 0.5, -0.3]
        fits.append(least_squares(misfit, start, bounds=(low, [9, 2.4, 9, 2.4, 9, 9, 0.1, 0.1, 2.0, 0.3])))
    w = rows(min(fits, key=lambda fit: float(fit.cost)).x, plate[:, 0])
    # left w_right m = right w_left m in every state, with the weight of its light.
    across, weight = plate[:, 1:2] * w[:, 1] - plate[:, 2:] * w[:, 0], np.ones(len(w))
    for _ in range(5):
        m = np.linalg.svd(across / weight[:, None])[2][-1]
        weight = w.sum(axis=1) @ m / m[0]
    return np.asarray((m / m[0]).reshape(4, 4))


@dataclass(frozen=True)
class Starts:
    """What two nominal files make of the same captures, whose azimuths of some plates are 100 degrees apart.

    Attributes
    ----------
    mueller : (2, 16) M/m00 of another sample, with the file near the truth and with the other.
    stated : (16,) its standard errors.
    ratio : largest ratio of the standard errors of a value of the train, either way round.
    branch : what the second report says of the sign.
    """

    name: str
    mueller: Array
    stated: Array
    ratio: float
    branch: str | None

    @property
    def apart(self) -> float:
        """Largest difference of an element, in standard errors."""
        return float(np.max(np.abs(self.mueller[1] - self.mueller[0])[1:] / self.stated[1:]))

    @property
    def same_signs(self) -> bool:
        """Whether row 3 and column 3 have the same sign."""
        first, second = (m.reshape(4, 4)[[1, 2, 3, 3], [3, 3, 1, 2]] for m in self.mueller)
        return bool(first @ second > 0)


PLATES = ("psg_retarder", "psa_retarder")
#: Instruments with two plates, one of them wrong by 100 degrees in the second file.
TWO_PLATES = ("drr_wollaston", "drr_5to1", "drr_single_detector", "drr_imaging_630nm", "rgb950")


def two_starts(name: str, folder: Path, plates: Sequence[str] = PLATES[1:], by_deg: float = 100.0) -> Starts:
    """Diagnose one capture of air from two nominal files; reduce one capture of another sample with both results."""
    bench, random = BENCHES[name], np.random.default_rng(2)
    calibrate = tuple(f"{plate}.{field}_deg" for plate in PLATES for field in ("azimuth", "retardance"))
    nominal = InstrumentModel.load(INSTRUMENTS / f"{name}.yaml").at(bench.nm)
    nominal = nominal.model_copy(update={"beams": None, "calibrate": calibrate, "belongs_to": {}})
    true = _turned(nominal, psg_retarder=3.0, psa_retarder=-2.0)
    file = folder / f"{name}.yaml"
    file.write_text(dump_yaml(nominal), encoding="utf-8")
    air, other = (
        emulated_capture(true, bench, m, kind, file=file, random=random)
        for m, kind in ((np.eye(4), "air"), (SAMPLE, "unknown"))
    )
    found, products = [], []
    for by in (0.0, by_deg):
        model, new = _turned(nominal, **dict.fromkeys(plates, by)), folder / f"{name}_{by:g}.yaml"
        found.append(diagnose_captures([air], model)[0].diagnosis)
        write_instrument(new, model, found[-1])
        products.append(_relative(_product(Reduction(other, new).make(new.with_suffix(".h5"), True))))
    errors = [{key: value.stderr or 0.0 for key, value in d.calibrated.items()} for d in found]
    ratios = [errors[1][key] / errors[0][key] for key in errors[0]]
    return Starts(
        name,
        np.array([values for values, _ in products]),
        products[0][1],
        max(max(r, 1 / r) for r in ratios),
        found[1].branch,
    )


def _turned(model: InstrumentModel, **by_deg: float) -> InstrumentModel:
    azimuths = {p: {"azimuth_deg": float(model.value_of(f"{p}.azimuth_deg") or 0.0) + by} for p, by in by_deg.items()}  # type: ignore[arg-type]
    return model.with_values(azimuths)  # type: ignore[arg-type]


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


def _product(path: Path) -> dict[str, Array]:
    """Means over the pixels of the datasets of a product."""
    with Product(path) as product:
        names = {"mueller", "mueller_errors", "mueller_systematic", "s0", "s1", "s2", "s1_errors", "s2_errors"}
        names |= {"stokes", "stokes_errors", "stokes_systematic", "s1_systematic", "s2_systematic"}
        found = {name: np.asarray(product.get(name), dtype=float) for name in names & set(product.names)}
    return {name: values.mean(axis=(-2, -1)) for name, values in found.items()}


def _relative(product: dict[str, Array]) -> tuple[Array, Array]:
    """M/m00, or S/S0, and its standard error."""
    if "s0" in product:
        product["stokes"] = np.array([product["s0"], product["s1"], product["s2"], np.nan])
        for ending in ("errors", "systematic"):
            if f"s1_{ending}" in product:
                product[f"stokes_{ending}"] = np.array([0.0, product[f"s1_{ending}"], product[f"s2_{ending}"], np.nan])
    kind = "stokes" if "stokes" in product else "mueller"
    values, systematic = product[kind].ravel(), product.get(f"{kind}_systematic", np.zeros(1))
    return values / values[0], np.hypot(product[f"{kind}_errors"], systematic).ravel() / values[0]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def rows(folder: Path) -> Iterator[Row]:
    """All lines of the table."""
    for name in BENCHES:
        yield emulated(name, folder)
    yield mirror_frames(folder)
    files = find_files("drr-wollaston-nir", [SHIPPED, DATA])
    for nm in MEASURED_NM if files is not None else ():
        yield half_wave_plate(nm, files, folder)


def _print_starts() -> None:
    print("| instrument | plates off | by | difference / standard error | same sign | ratio of standard errors |")
    print("|---|---|---|---|---|---|")
    for name in TWO_PLATES:
        for by in (40.0, 80.0, 100.0, 130.0, 170.0, 260.0):
            for plates in (PLATES[1:], PLATES):
                with tempfile.TemporaryDirectory() as folder:
                    found = two_starts(name, Path(folder), plates, by)
                same = "yes" if found.same_signs else "no"
                figures = f"{found.apart:.2f} | {same} | {found.ratio:.2f}"
                print(f"| {name} | {len(plates)} | {by:g} | {figures} |", flush=True)


def _chosen(option: str, folder: Path) -> Iterator[Row]:
    files = find_files("drr-wollaston-nir", [SHIPPED, DATA])
    if option == "--draws" and files is not None:
        for nm, draw in ((nm, draw) for nm in MEASURED_NM for draw in range(8)):
            with tempfile.TemporaryDirectory() as own:
                yield half_wave_plate(nm, files, Path(own), draw)
    elif option == "--air":
        names = ("rgb950", "drr_5to1", "drr_wollaston", "linear_mueller")
        for name, fault, seed in ((n, f, k) for n in names for f in OF_AIR for k in (2, 3)):
            with tempfile.TemporaryDirectory() as own:
                yield replace(emulated(name, Path(own), seed, OF_AIR[fault]), name=f"{name}, {fault}")
    else:
        yield from rows(folder)


def main() -> None:
    """Print the table, or that of an option."""
    option = sys.argv[1] if len(sys.argv) > 1 else ""
    if option == "--starts":
        _print_starts()
        return
    print("| instrument | reference | nominal file | train alone | written file | stated error | verdict on air |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for row in _chosen(option, Path(folder)):
            print(row.line, flush=True)


if __name__ == "__main__":
    main()
