"""Output of `process import --dry-run`: the states as understood, and a strip of their frames."""

from itertools import islice

import numpy as np
import typer

from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.importing import understand

#: Most frames in the strip and rows in the table.
SHOWN = 12


def show_understood(request: ImportRequest) -> None:
    """Print the table of states, and draw the first frames to NAME.import.png."""
    from matplotlib.figure import Figure

    understood = understand(request)
    states, source = understood.states, understood.source
    _, rows, columns = source.shape
    typer.echo(
        f"{len(states)} states, {states.role.count('dark')} of them dark; channels: {', '.join(source.channels)}; "
        f"frames of {columns} x {rows} pixels, {source.dtype}"
    )
    head = ["state", "role", *(f"{axis} (deg)" for axis in states.angles_deg), "frame", "mean of the frame"]
    frames = list(islice(source.frames(), SHOWN))
    lines = [
        [
            str(k),
            states.role[k],
            *(f"{angles[k]:.3f}" for angles in states.angles_deg.values()),
            source.names[k] if k < len(source.names) else f"[{k}]",
            f"{np.nanmean(frame):.6g}",
        ]
        for k, frame in enumerate(frames)
    ]
    widths = [max(len(line[k]) for line in [head, *lines]) for k in range(len(head))]
    for line in [head, *lines]:
        typer.echo("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
    if len(states) > SHOWN:
        typer.echo(f"... {len(states) - SHOWN} more states")
    if rows * columns == 1:
        return
    figure = Figure(figsize=(1.4 * len(frames), 1.7), layout="constrained")
    for k, (axis, frame) in enumerate(zip(np.atleast_1d(figure.subplots(1, len(frames))), frames, strict=True)):
        axis.imshow(frame[0], cmap="gray")
        axis.set_title(f"state {k}", fontsize=8)
        axis.set_axis_off()
    path = request.out.with_suffix(".import.png")
    figure.savefig(path, dpi=100)
    typer.echo(f"figure: {path}")
