"""The `process` command: everything from a capture file onwards."""

from __future__ import annotations

from collections.abc import Sequence

from processing.commands import (
    axostep,
    calibrate,
    camera,
    campaign,
    design,
    exporting,
    geometry,
    importing,
    quantities,
    reduce,
    reflectance,
    report,
    tables,
    xi0,
)
from processing.commands.command_line import Version, application, run

app = application("process", "Captures to Mueller and Stokes images, reflectance, coherency eigenvalues and reports.")

# One line a module that brings commands. It must not import anything heavy at its top: `--help` is fast.
axostep.register(app)
calibrate.register(app)
camera.register(app)
importing.register(app)
quantities.register(app)
reduce.register(app)
report.register(app)
campaign.register(app)
design.register(app)
exporting.register(app)
geometry.register(app)
reflectance.register(app)
tables.register(app)
xi0.register(app)


@app.callback(no_args_is_help=True)
def _process(version: Version = False) -> None:
    pass


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `process`; ends in SystemExit."""
    run(app, argv)


if __name__ == "__main__":
    main()
