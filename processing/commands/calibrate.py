"""`process calibrate`: parameters of an instrument from a capture of a known sample."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.command_line import CALIBRATION, Overwrite, ProductFile, command

if TYPE_CHECKING:
    from processing.calibration.train import CurveFit, FittedValues


@command("calibrate", CALIBRATION)
def calibrate_command(
    *,
    captures: Annotated[
        list[Path], typer.Argument(help="Captures of air, a mirror or another known sample, at any wavelengths.")
    ],
    instrument: Annotated[Path, typer.Option(help="Instrument file that the fit starts from.")],
    free: Annotated[str, typer.Option(help="Parameters to fit: element.field,element.field,...")],
    region: Annotated[
        str | None, typer.Option(help="Pixels to average: r0:r1,c0:c1; default: the middle half of the frame.")
    ] = None,
    dispersion: Annotated[
        int | None,
        typer.Option(help="Optics follow a polynomial in 1/wavelength with so many coefficients, not a value at each."),
    ] = None,
    at: Annotated[
        str | None, typer.Option(help="With --dispersion: further wavelengths inside the range, nm,nm,...")
    ] = None,
    write: Annotated[Path | None, typer.Option(help="New instrument file with the fitted values.")] = None,
) -> None:
    """Fit element parameters (azimuth_deg, retardance_deg, ...) to region means; the throughput is eliminated.

    Captures at several wavelengths are fitted at once: azimuths and ratios change by the same amount in all of them.
    """
    from processing.calibration.fitted_file import write_fitted
    from processing.calibration.known_sample import part_of
    from processing.calibration.train import POOR_FIT, fit_curves, fit_trains
    from processing.doors import require_distinct, require_new
    from processing.instrument.model import InstrumentModel
    from processing.maps.region import parse_region
    from processing.reduction.instrument_of_capture import require_belongs
    from processing.storage.captures.capture import Capture

    if write is not None:
        require_new(write)
    require_distinct(captures)
    further = _wavelengths(at, dispersion)
    model = InstrumentModel.load(instrument)
    parts, titles, simulated = [], [], False
    for capture in captures:
        with Capture(capture, by_super_pixel=True) as source:
            nm = source.header.wavelength_nm
            rows, columns = parse_region(region, source.frame_shape)
            require_belongs(source, model.at(nm))
            parts.append(part_of(source, model.at(nm), rows, columns))
            simulated |= source.simulated
        where = f"rows {rows.start}:{rows.stop}, columns {columns.start}:{columns.stop}"
        titles.append(f"{capture.name}: {where}, {nm:g} nm")
    curves = None if dispersion is None else fit_curves(parts, free.split(","), dispersion)
    calibrations = fit_trains(parts, free.split(",")) if curves is None else curves.calibrations
    fitted: dict[float, FittedValues] = {p.wavelength_nm: r for p, r in zip(parts, calibrations, strict=True)}
    if simulated:
        typer.echo("SIMULATED data")
    for title, result in zip(titles, calibrations, strict=True):
        _tell(title, result)
        typer.echo(f"  residual {100 * result.residual_over_mean:.3f} % of the mean signal (rms)")
    if curves is not None:
        for nm in further:
            fitted[nm] = curves.at(model, nm)
            _tell(f"{nm:g} nm, from the curves", fitted[nm])
        _tell_curves(curves)
    worst = max(result.residual_over_mean for result in calibrations)
    if worst > POOR_FIT:
        typer.echo("warning: a poor fit; start from values closer to the truth, or free more parameters", err=True)
    if write is not None:
        names = ", ".join(capture.name for capture in captures)
        smooth = f", curves of {dispersion} coefficients" if curves else ""
        note = f"process calibrate of {names}{smooth}, residual {100 * worst:.2f} % of the mean"
        write_fitted(instrument, write, fitted, note)
        typer.echo(str(write))


@command("calibrate-mosaic", CALIBRATION)
def calibrate_mosaic_command(
    capture: Annotated[Path, typer.Argument(help="Mosaic capture of an even field behind a turning polarizer.")],
    instrument: Annotated[Path | None, typer.Option(help="Instrument file; default: the one in the capture.")] = None,
    out: ProductFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Fit the analysis vector of every pixel of a polarization sensor (Powell and Gruev)."""
    from processing.calibration.mosaic import fit_response
    from processing.commands.summary import summary
    from processing.reduction.instrument_of_capture import choose_model
    from processing.storage.captures.capture import Capture
    from processing.storage.products.product import Step, file_identity

    product = out or capture.with_suffix(".analyzers.h5")
    with Capture(capture) as source:
        files = {"capture": capture} if instrument is None else {"capture": capture, "instrument": instrument}
        inputs = tuple(file_identity(path, role) for role, path in files.items())
        step = Step("calibrate-mosaic", {"capture": capture.name}, inputs)
        fit_response(source, choose_model(source, instrument), product, step, overwrite=overwrite)
    summary(product)


def _tell(title: str, fitted: FittedValues) -> None:
    typer.echo(title)
    for name, value, stderr in zip(fitted.names, fitted.values, fitted.stderr, strict=True):
        typer.echo(f"  {name:32s} {value:12.5f} +- {stderr:.5f}")


def _tell_curves(curves: CurveFit) -> None:
    """The fit of the curves, compared with one value at each wavelength."""
    from processing.calibration.train import UNLIKELY

    typer.echo(
        f"curves of {', '.join(curves.curved)}: residual {100 * curves.residual_over_mean:.3f} % of the mean; "
        f"with a value at each wavelength {100 * curves.separate_residual:.3f} %"
    )
    if curves.chance is None:
        typer.echo("  as many coefficients as wavelengths: nothing is smoothed")
    elif curves.chance < UNLIKELY:
        typer.echo(
            f"warning: if the curves were true, they would be as much worse with a chance of {curves.chance:.1g} only: "
            "take more coefficients, or leave --dispersion out",
            err=True,
        )


def _wavelengths(text: str | None, dispersion: int | None) -> list[float]:
    from processing.calibration.known_sample import CalibrationError

    if text is None:
        return []
    if dispersion is None:
        raise CalibrationError("--at: other wavelengths follow from curves alone; give --dispersion as well")
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise CalibrationError(f"--at {text}: write wavelengths as 500,550.5") from None
