"""`process init`: ten questions, and an instrument file with comments from the answers."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import DATA, command

_GENERATORS = {
    "none": "unpolarized light, or the sample is the source",
    "polarizer": "a polarizer that stands still",
    "turning-polarizer": "a polarizer that turns",
    "turning-retarder": "a polarizer, then a retarder that turns",
}
_ANALYZERS = {
    "polarizer": "a polarizer that stands still",
    "turning-polarizer": "a polarizer that turns",
    "turning-retarder": "a retarder that turns, then a polarizer",
    "camera": "a polarization camera",
    "turning-retarder-camera": "a retarder that turns, then a polarization camera",
}
_CAMERA = """\
# The super-pixel of the sensor: each channel is the pixels behind one micropolarizer.
channels:
  - {name: "0", elements: [{kind: polarizer, name: micropolarizer_0, azimuth_deg: 0}]}
  - {name: "45", elements: [{kind: polarizer, name: micropolarizer_45, azimuth_deg: 45}]}
  - {name: "90", elements: [{kind: polarizer, name: micropolarizer_90, azimuth_deg: 90}]}
  - {name: "135", elements: [{kind: polarizer, name: micropolarizer_135, azimuth_deg: 135}]}
# Channels of two rows and two columns, from the first pixel on.
mosaic: [["90", "45"], ["135", "0"]]
"""


@command("init", DATA)
def init_command(
    what: Annotated[str, typer.Argument(help="What to describe: instrument.")] = "instrument",
    out: Annotated[Path, typer.Option(help="New instrument file (YAML).")] = Path("my_polarimeter.yaml"),
) -> None:
    """Ask ten questions about a polarimeter and write its instrument file. Enter takes the answer in brackets."""
    from processing.doors import require_new
    from processing.errors import ProcessError
    from processing.instrument.determined_basis import determined_basis, determined_elements
    from processing.instrument.model import InstrumentModel
    from processing.whole_file import write_new_text
    from processing.yaml_file import parse_yaml

    if what != "instrument":
        raise ProcessError(f"{what}: only an instrument can be described. Type: process init instrument")
    require_new(out)
    text = ask(typer.prompt)
    model = parse_yaml(text, InstrumentModel, source=str(out))
    write_new_text(out, text)
    first = next((nm for nm in model.wavelengths_nm or ()), 550.0)
    elements = determined_elements(determined_basis(model.at(first)))
    names = ", ".join(f"m{k // 4}{k % 4}" for k in range(16) if elements[k])
    typer.echo(f"it determines {names or 'the Stokes vector that one polarized state sends back'}")
    typer.echo(f"{out}\nnext: process import --instrument {out} --states LOG.csv --stack FRAMES --dry-run")


def ask(prompt: Callable[..., str]) -> str:
    """The text of an instrument file from the answers; `prompt` asks (text, default) and returns an answer."""
    name = prompt("1. Name of the polarimeter", default="my polarimeter").strip()
    nm = _numbers(prompt, "2. Wavelengths in nm, with commas", "550")
    generator = _choice(prompt, "3. Between source and sample", _GENERATORS)
    generator_deg = analyzer_deg = 0.0
    if generator != "none":
        generator_deg = _numbers(prompt, "4. Azimuth of its polarizer in degrees, from horizontal", "0")[0]
    psg = _turning(prompt, 5, "psg", generator)
    analyzer = _choice(prompt, "7. Between sample and camera", _ANALYZERS)
    if not analyzer.endswith("camera"):
        analyzer_deg = _numbers(prompt, "8. Azimuth of its polarizer in degrees", "0")[0]
    psa = _turning(prompt, 9, "psa", analyzer)
    lines = [
        "# Made by `process init`. Angles are in degrees, counterclockwise from +x for an observer who looks into the",
        "# beam; the azimuth of a retarder is that of its fast axis. docs/instrument-files.md lists all fields.",
        "kind: instrument",
        f"name: {_quote(name)}",
        f"wavelengths_nm: [{', '.join(f'{value:g}' for value in nm)}]",
        "# Elements between source and sample, in the order of the light.",
        *_elements("generator", generator, "psg", generator_deg, turning=psg),
        "# Elements between sample and detector, in the order of the light.",
        *_elements("analyzer", analyzer, "psa", analyzer_deg, turning=psa),
    ]
    text = "\n".join(lines) + "\n" + (_CAMERA if analyzer.endswith("camera") else "")
    nominal = [f"{side}_retarder.retardance_deg" for side, axis in (("psg", psg), ("psa", psa)) if axis.retardance_deg]
    if nominal:
        text += "# Only nominal: `diagnose` fits them to a capture of air. Delete a line whose value is measured.\n"
        text += "calibrate:\n" + "".join(f"  - {value}\n" for value in nominal)
    return text


class _Turning:
    """Axis and retardance of the element that turns; an empty axis without one."""

    def __init__(self, axis: str = "", retardance_deg: float | None = None) -> None:
        self.axis, self.retardance_deg = axis, retardance_deg


def _turning(prompt: Callable[..., str], number: int, axis: str, kind: str) -> _Turning:
    if not kind.startswith("turning"):
        return _Turning()
    axis_name = prompt(f"{number}. Name of the axis that turns it, a column of your table", default=axis).strip()
    if "retarder" not in kind:
        return _Turning(axis_name)
    return _Turning(axis_name, _numbers(prompt, f"{number + 1}. Retardance in degrees (nominal)", "90")[0])


def _elements(side: str, kind: str, short: str, polarizer_deg: float, *, turning: _Turning) -> list[str]:
    axis = f", axis: {_quote(turning.axis)}" if turning.axis else ""
    retarder = f"  - {{kind: retarder, name: {short}_retarder{axis}, azimuth_deg: 0, retardance_deg: "
    retarder += f"{turning.retardance_deg or 0:g}}}"
    polarizer_axis = axis if "retarder" not in kind else ""
    polarizer = f"  - {{kind: polarizer, name: {short}_polarizer{polarizer_axis}, azimuth_deg: {polarizer_deg:g}}}"
    elements = [polarizer] if "polarizer" in kind or kind == "turning-retarder" else []
    if "retarder" in kind:
        elements = [*elements, retarder] if side == "generator" else [retarder, *elements]
    return [f"{side}:", *elements] if elements else [f"{side}: []"]


def _choice(prompt: Callable[..., str], question: str, choices: dict[str, str]) -> str:
    names = list(choices)
    listed = "".join(f"\n   {number} {choices[name]}" for number, name in enumerate(names, 1))
    while True:
        answer = prompt(f"{question}:{listed}\n  ", default=str(len(names) if "camera" not in names else 3)).strip()
        if answer in names:
            return answer
        if answer.isdecimal() and 1 <= int(answer) <= len(names):
            return names[int(answer) - 1]
        typer.echo(f"{answer!r} is none of 1 to {len(names)}.")


def _numbers(prompt: Callable[..., str], question: str, default: str) -> list[float]:
    while True:
        answer = prompt(question, default=default)
        try:
            return [float(part) for part in answer.split(",")]
        except ValueError:
            typer.echo(f"{answer!r} is no number.")


def _quote(text: str) -> str:
    import json

    return json.dumps(text)
