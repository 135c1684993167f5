"""The `process` command: everything from a capture file onwards."""

import pkgutil
from collections.abc import Sequence
from importlib import import_module

import processing.commands as folder
from processing.commands.command_line import COLLECTED, Version, application, run

app = application("process", "Captures to Mueller and Stokes images, reflectance, coherency eigenvalues and reports.")


@app.callback(no_args_is_help=True)
def _process(version: Version = False) -> None:
    pass


# Every module beside this one may bring commands. It must not import anything heavy at its top: `--help` is fast.
for _module in pkgutil.iter_modules(folder.__path__, f"{folder.__name__}."):
    if _module.name != __name__ and not _module.ispkg:
        import_module(_module.name)
for _name, _purpose, _function in COLLECTED:
    app.command(_name, rich_help_panel=_purpose)(_function)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `process`; ends in SystemExit."""
    run(app, argv)


if __name__ == "__main__":
    main()
