"""From a capture of a known sample to the Mueller matrix of another sample, for every instrument in configs/.

Each instrument is wrong by what its file does not say. One capture of air is diagnosed, the file is written, and a
capture of another sample is reduced with the nominal and with the written file. The references are no part of any fit:
the emulated sample, or the ratio of the channels of measured data.

    python benchmarks/instrument_chain.py    prints the table of docs/studies/instrument-chain.md
"""

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import WriteError, write_instrument
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.public_data.conversion import PublicStates, mirror_means, tables_of
from processing.public_data.sets import SHIPPED, find_files
from processing.steps.reduction import Reduction
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from processing.storage.products.product import Product
from processing.yaml_file import dump_yaml
from simulators.blind.emulated_instruments import BENCHES, INSTRUMENTS, SAMPLE, Array, Bench, Wrong, emulated_capture

#: Where public measured data are that may not be in the tree.
DATA = Path(os.environ.get("UMOV_DATA", INSTRUMENTS.parents[2] / "shared" / "data"))
MEASURED_NM, KINDS = (1200, 1300, 1600, 1950), ("air", "plate")


@dataclass(frozen=True)
class Row:
    """What became of another sample.

    Attributes
    ----------
    nominal, train, written : rms difference from the reference, over the elements of M/m00 (S/S0) that the instrument
        determines, reduced with the file as it was, with the fitted values of the train alone, and as it was written.
    stated : rms of the standard errors in the product, noise and systematic.
    reference : name of the reference values.
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
    for value, error in bench.wrong.items():
        place, _, field = value.rpartition(".")
        true = true.with_values({place: {field: float(true.value_of(value) or 0.0) + error}})  # type: ignore[arg-type]
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
    sample = emulated_capture(true, bench, SAMPLE, "unknown", file=file, random=random)

    def truth(product: dict[str, Array]) -> Array:
        if "stokes" not in product:
            return SAMPLE / SAMPLE[0, 0]
        stokes = SAMPLE @ true.generator_states({})[0]
        return np.asarray(stokes / stokes[0])

    return chain(name, air, sample, file, truth=truth, reference="the emulated sample")


def chain(
    name: str, air: Path, sample: Path, file: Path, *, truth: Callable[[dict[str, Array]], Array], reference: str
) -> Row:
    """Diagnose a capture, write, and reduce another with both files."""
    model = InstrumentModel.load(file)
    diagnosis = diagnose_captures([air], model)[0].diagnosis
    new = file.with_name(f"{file.stem}.new.yaml")
    try:
        write_instrument(new, model, diagnosis)
    except WriteError:
        new = file
    train = file.with_name(f"{file.stem}.train.yaml")
    train.write_text(dump_yaml(InstrumentModel.load(new).model_copy(update={"effects": (), "systematic": ()})))
    errors = []
    for k, used in enumerate((file, train, new)):
        product = means_of(Reduction(sample, used).make(sample.with_suffix(f".{k}.h5"), True))
        values, stated = relative(product)
        expected = truth(product).reshape(values.shape)
        valid = np.isfinite(values) & (np.arange(values.size) > 0)
        errors.append((_rms(values[valid] - expected[valid]), _rms(stated[valid])))
    (nominal, _), (train_only, _), (written, stated) = errors
    return Row(name, nominal, train_only, written, stated, diagnosis.verdict, reference)


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
        return min((reference, flip @ reference @ flip), key=lambda candidate: _rms(candidate - m))

    if draw:
        indices = sorted(np.random.default_rng(draw).choice(len(air.rows), len(air.rows) - 10, replace=False))
        air = replace(air, rows=tuple(f"{n},{air.rows[k].partition(',')[2]}" for n, k in enumerate(indices)))
    return _measured("drr_wollaston", (air, plate), folder, truth, reference="the ratio of the channels")


def ratio_of_channels(air: Array, plate: Array) -> Array:
    """M/m00 of a plate from (left - right)/(left + right) alone, tables (N, 3) of angle in degrees, left and right.

    It shares no code with the project's fits: two retarders, elliptical light, azimuth, extinction and gain of the
    channels.
    """
    random = np.random.default_rng(0)

    def rows(x: Array, theta_deg: Array) -> Array:
        t = np.deg2rad(theta_deg)
        light = mueller.retarder(np.deg2rad(45.0), x[9]) @ mueller.polarizer(0.0, 0.0)[:, :1]
        g = (mueller.retarder(t + x[0], x[1]) @ light)[..., 0]
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


def means_of(path: Path) -> dict[str, Array]:
    """Means over the pixels of the datasets of a product."""
    with Product(path) as product:
        names = {"mueller", "mueller_errors", "mueller_systematic", "s0", "s1", "s2", "s1_errors", "s2_errors"}
        names |= {"stokes", "stokes_errors", "stokes_systematic", "s1_systematic", "s2_systematic"}
        planes = {name: np.asarray(product.get(name), dtype=float) for name in names & set(product.names)}
    return {name: values.mean(axis=(-2, -1)) for name, values in planes.items()}


def relative(product: dict[str, Array]) -> tuple[Array, Array]:
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


if __name__ == "__main__":
    print("| instrument | reference | nominal file | train alone | written file | stated error | verdict on air |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(Path(folder)):
            print(row.line, flush=True)
