"""The study as one page: the paper's numbers next to ours, figure by figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
from paper_study import figures
from paper_study.acquire import FAULT, SHOWN_DEG, Size
from paper_study.figures import Shown
from paper_study.process import BODY, SPHERE, TABLE_I, TRUE_MATERIAL, BodyProducts, FaultStudy, SphereStudy

from processing.campaign.run import PAPER, CampaignResult
from processing.reflectance.base import load_reflectance
from processing.reflectance.tables import ScatteringTable
from processing.reports.figure_style import png
from processing.reports.template import Figure, ReportSection, render
from processing.storage.products.product import Product

LABELS = {"psi_deg": "psi / degrees", "magnitude_percent": "|D| / %", "xi0_percent": "xi0 / %"}
#: Largest deviations from triple degeneracy that the paper tells, of the light.
PAPER_DEVIATION = {451: 0.09, 662: 0.03}

Table = tuple[str, Sequence[Sequence[str]]]
QUANTITIES = tuple(figures.NOISE)


@dataclass(frozen=True)
class Budget:
    """Mean squares over the arm angles of one figure of merit at one wavelength; a negative one made it better.

    Contributions add as squares where they are independent. The noise is what the error bars of the captures predict;
    each other one is by how much the square of the deviation falls when its cause is taken away. `remainder` is the
    share with the true sphere and material and without noise: for xi0, the scene is not triply degenerate.
    """

    total: float
    noise: float
    registration: float
    material: float
    remainder: float


def budget(study: SphereStudy, nm: float, quantity: str) -> Budget:
    """The budget of a figure of merit of `processing.campaign.run.Row`."""
    runs = (study.as_told, study.registered, study.true_material)
    total, registered, true_material = (_mean_square(run, nm, quantity) for run in runs)
    noises = [_mean_square(run, nm, figures.NOISE[quantity]) for run in runs]
    # The noise differs a little between the runs: other pixels count.
    nominal, aligned, ideal = (a - b for a, b in zip((total, registered, true_material), noises, strict=True))
    return Budget(total, noises[0], nominal - aligned, aligned - ideal, ideal)


def signed_root(square: float) -> float:
    """Root of a mean square; minus that of its size where it is negative."""
    return float(np.sign(square) * np.sqrt(abs(square)))


def _mean_square(result: CampaignResult, nm: float, name: str) -> float:
    values = [getattr(row, name) for row in result.rows if row.wavelength_nm == nm]
    return float(np.nanmean(np.square(values)))


def write_page(
    out: Path,
    size: Size,
    sphere: SphereStudy,
    body: dict[float, BodyProducts],
    *,
    fault: FaultStudy,
    seconds: dict[str, float],
) -> None:
    """Write the HTML file."""
    wavelengths = sorted({row.wavelength_nm for row in sphere.as_told.rows})
    paths = {nm: _shown_product(sphere.folder, nm) for nm in wavelengths}
    dominant = {nm: figures.dominant(path, SPHERE, TABLE_I) for nm, path in paths.items()}
    of_body = {nm: figures.dominant(products.mueller, BODY, TABLE_I) for nm, products in body.items()}
    sections = [
        _numbers(size, sphere, wavelengths, seconds),
        _section("Scattering angles over sphere and body", [figures.scattering_angles(size.pixels)]),
        _section("The two terms of the model", [figures.model_terms(wavelengths[-1], size.pixels)]),
        *(
            _section(f"Dominant process of the {name}, measured and modelled", [figures.dominant_images(name, images)])
            for name, images in (("sphere", dominant), ("body", of_body))
        ),
        _section(
            f"psi and |D| at Omega {SHOWN_DEG:g} degrees",
            [figures.orientation(dominant), figures.diattenuation(dominant)],
        ),
        _section("Deviations against Omega", [figures.deviations(sphere)], [_rows(sphere.as_told)]),
        _tables(sphere, wavelengths, size.pixels),
        _section("Eigenvalues of the body", [figures.eigenvalues(body)]),
        _section("The body between polarizers", [figures.polarizer_pairs(body)]),
        _materials(sphere, wavelengths),
        _budget(sphere, wavelengths),
        _fault(fault, wavelengths),
    ]
    stamp = f"Made by umov {version('umov')}, `./lab paper`, on {datetime.now(UTC).isoformat(timespec='seconds')}."
    title = "Efficient Modeling of Depolarizing Mueller BRDFs: the study on emulated instruments"
    out.write_text(render(title, True, stamp, sections), encoding="utf-8")


def _section(
    title: str, shown: Sequence[Shown], tables: Sequence[Table] = (), summary: Sequence[tuple[str, str]] = ()
) -> ReportSection:
    return ReportSection(title, summary, [Figure(png(s.figure), s.caption) for s in shown], tables)


def _numbers(size: Size, sphere: SphereStudy, wavelengths: Sequence[float], seconds: dict[str, float]) -> ReportSection:
    head = ["", *(f"{nm:g} nm, {who}" for nm in wavelengths for who in ("paper", "here", "here, noise alone"))]
    rows = [head]
    for name in QUANTITIES:
        cells = []
        for nm in wavelengths:
            result = sphere.as_told
            noise = result.average(nm, figures.NOISE[name])
            cells += [f"{getattr(PAPER[round(nm)], name):.2f}", f"{result.average(nm, name):.2f}", f"{noise:.2f}"]
        rows.append([f"RMSD of {LABELS[name]}, mean over Omega", *cells])
    largest = ["largest deviation of xi1..xi3 from their mean, set in the bench after the paper"]
    for nm in wavelengths:
        of_nm = [row for row in sphere.as_told.rows if row.wavelength_nm == nm]
        values = [max(getattr(row, name) for row in of_nm) for name in ("eigenvalue_deviation", "eigenvalue_noise")]
        largest += [f"{PAPER_DEVIATION[round(nm)]:.2f}", f"{values[0]:.3f}", f"{values[1]:.3f}"]
    rows.append(largest)
    angles = "Omega " + ", ".join(f"{omega:g}" for omega in size.omega_deg) + " degrees"
    nm_told = " and ".join(f"{nm:g}" for nm in wavelengths)
    summary = [
        (
            "what was done",
            f"{angles}; {nm_told} nm; RGB950's 40 states and {size.frames} frames of a linear Stokes camera, "
            f"{size.pixels} x {size.pixels} pixels; taken by `acquire --campaign` on emulated devices",
        ),
        (
            "what is in the bench and not told",
            "a material near to Table I, small eigenvalues up to 9 and 3 % apart, the sphere 0.3 mm to the side and "
            "0.5 % too large; for the last part a plate that somebody remounted",
        ),
        (
            "what a comparison is worth",
            "xi0, M00 and the material of the bench are invented (the paper tells no law of them): the paper's numbers "
            "show the size of things. The small eigenvalues are not: they are set 9 and 3 % apart after the paper, and "
            "the row of their deviation only shows that the chain returns what the bench has",
        ),
        (
            "not in these numbers",
            "eigenvalue deviations here are the 99th percentile without their noise, the paper tells the largest with "
            "it; the body is a generated one, not the Stanford bunny",
        ),
        ("time", ", ".join(f"{name} {value:.0f} s" for name, value in seconds.items())),
    ]
    return ReportSection("The paper's numbers and ours", summary, (), [("Mean deviations", rows)])


def _rows(result: CampaignResult) -> Table:
    names = [name for quantity in QUANTITIES for name in (quantity, figures.NOISE[quantity])]
    head = ["nm", "Omega", *(text for quantity in QUANTITIES for text in (LABELS[quantity], "its noise"))]
    body = [
        [f"{row.wavelength_nm:g}", f"{row.omega_deg:g}", *(f"{getattr(row, name):.2f}" for name in names)]
        for row in result.rows
    ]
    return "Every angle", [head, *body]


def _tables(sphere: SphereStudy, wavelengths: Sequence[float], pixels: int) -> ReportSection:
    rows = [["", "bins filled of 91 x 91 x 361", "samples"]]
    for (kind, nm), path in sphere.as_told.tables.items():
        table = ScatteringTable.load(path)
        filled = int(np.sum(table.count > 0))
        rows.append([f"{kind}, {nm:g} nm", f"{filled}", f"{int(table.count.sum())}"])
    shown = [figures.lookup_tables(sphere, nm, pixels) for nm in wavelengths]
    return _section("xi0 through look-up tables", shown, [("The tables", rows)])


def _materials(sphere: SphereStudy, wavelengths: Sequence[float]) -> ReportSection:
    declared, true = load_reflectance(TABLE_I), load_reflectance(TRUE_MATERIAL)
    rows = [["", "n", "k", "a", "b", "reduced chi-square", "pixels"]]
    for nm in wavelengths:
        for source, material in (("paper, Table I", declared), ("the bench, not told", true)):
            c = material.constants[nm]
            rows.append([f"{nm:g} nm, {source}", f"{c.n:g}", f"{c.k:g}", f"{c.a:g}", f"{c.b:g}", "", ""])
        for images, fitted in sphere.fits[nm].items():
            fit = fitted.fit
            cells = [
                f"{value:.3f} ± {error:.3f}" if is_determined else "not determined"
                for value, error, is_determined in zip(fit.constants, fit.stderr, fit.identified.values(), strict=True)
            ]
            rows.append([f"{nm:g} nm, {images}", *cells, f"{fit.chi_square:.3g}", f"{fit.pixels}"])
    note = (
        "the paper's constants were found ad hoc. Here are both ways that its conclusions propose, on up to four "
        "angles: least squares on the dominant process, and linear correlation, which takes small eigenvalues that "
        "differ for another dominant process. Errors hold noise and misfit. A constant that is not determined has an "
        "error above 30 % of it, or is at a bound of the search: one angle and few pixels (--quick) cannot do better"
    )
    return ReportSection("Constants of the material, both ways", [("how", note)], (), [("n + ik, a, b", rows)])


def _budget(sphere: SphereStudy, wavelengths: Sequence[float]) -> ReportSection:
    head = ["", "in all", "noise", "registration", "constants", "rest"]
    rows = [head]
    for nm in wavelengths:
        for name in QUANTITIES:
            shares = budget(sphere, nm, name)
            squares = (shares.total, shares.noise, shares.registration, shares.material, shares.remainder)
            rows.append([f"{nm:g} nm, {LABELS[name]}", *(f"{signed_root(square):.2f}" for square in squares)])
    note = (
        "contributions as roots of mean squares over Omega; they add as squares. Noise: what the captures' error bars "
        "predict. Registration: by how much the square falls when the sphere is found in the images. Constants: when "
        "the bench's own material takes the place of Table I, which only a simulation can do. Rest: what then is left "
        "above the noise; for xi0 a scene that is not triply degenerate. A minus sign: the deviation grew"
    )
    return ReportSection("What the paper could not separate", [("how to read it", note)], (), [("Budget", rows)])


def _fault(fault: FaultStudy, wavelengths: Sequence[float]) -> ReportSection:
    lines = []
    for effect in fault.result.effects:
        values = ", ".join(f"{name} {value.text} {value.unit}" for name, value in effect.parameters.items())
        lines.append((f"found: {effect.kind}", values))
    text = f"{FAULT['parameter']} of {FAULT['element']} is {FAULT['offset']:g} degrees off, which no file says"
    summary = [("the fault", text), ("diagnose", f"{fault.result.verdict}. {fault.result.recommendation}"), *lines]
    rows = [["", "Omega", *(f"{LABELS[name]}, {when}" for name in QUANTITIES for when in ("before", "after"))]]
    for before, after in zip(fault.before.rows, fault.after.rows, strict=True):
        key = (before.wavelength_nm, before.omega_deg)
        cells = [f"{before.psi_deg:.2f}", f"{after.psi_deg:.2f}"]
        cells += [f"{before.magnitude_percent:.2f}", f"{after.magnitude_percent:.2f}"]
        cells += [f"{fault.xi0_percent[when][key]:.2f}" for when in ("before", "after")]
        rows.append([f"{key[0]:g} nm", f"{key[1]:g}", *cells])
    nm = wavelengths[-1]
    folders = [next(iter(result.tables.values())).parent for result in (fault.before, fault.after)]
    images = [figures.dominant(_shown_product(folder, nm), SPHERE, TABLE_I) for folder in folders]
    shown = [figures.fault_images(images[0], images[1], nm)]
    tables = [("Before and after, in the paper's figures of merit", rows)]
    return _section("An undeclared fault, found", shown, tables, summary)


def _shown_product(folder: Path, nm: float) -> Path:
    """The Mueller product of a folder at the wavelength and the angle that the paper shows."""
    for path in sorted(folder.glob("*.mueller.h5")):
        with Product(path) as product:
            header = product.header
            if header.wavelength_nm == nm and abs((header.omega_deg or 0) - SHOWN_DEG) < 0.1:
                return path
    raise FileNotFoundError(f"{folder}: no Mueller image at {nm:g} nm and Omega {SHOWN_DEG:g}")
