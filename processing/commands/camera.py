"""`process camera`: gain, read noise, black level and bad pixels of a camera."""

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import CALIBRATION, Overwrite, command
from processing.commands.drawing import FigureFile, NoFigure, draw


@command("camera", CALIBRATION)
def camera_command(
    *,
    captures: Annotated[list[Path], typer.Argument(help="Captures with dark states and with repeated states.")],
    out: Annotated[Path | None, typer.Option(help="Product file; default: beside the first capture.")] = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Overwrite = False,
) -> None:
    """Photon transfer: gain and read noise from states that repeat each other, bad pixels from dark states."""
    from processing.calibration.photon_transfer import write_camera
    from processing.commands.summary import summary
    from processing.doors import require_distinct
    from processing.storage.products.product import Step, file_identity

    require_distinct(captures)
    product = out or captures[0].with_suffix(".camera.h5")
    identities = tuple(file_identity(p, "capture") for p in captures if p.exists())
    step = Step("camera", {"captures": [p.name for p in captures]}, identities)
    write_camera(captures, product, step, overwrite)
    summary(product)
    draw(product, figure, no_figure)
