"""Commands that take several files and folders: one line for each, and a failed one does not end the others."""

from __future__ import annotations

import filecmp
import os
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import typer

from processing.commands.drawing import draw
from processing.commands.progress_bar import batch_bar, progress_bar
from processing.commands.summary import one_line, print_warnings, summary
from processing.errors import ProcessError

if TYPE_CHECKING:
    from processing.steps.file_step import FileStep, Progress, StepProduct


class Output(NamedTuple):
    """Files that one input became; `is_unchanged`: they existed, made of the same inputs with the same options."""

    paths: tuple[Path, ...]
    is_unchanged: bool
    facts: str = ""


def run_batch(
    action: str,
    unit: str,
    inputs: Sequence[Path],
    make: Callable[[Path, Progress], Output],
    *,
    print_result: Callable[[Output], None] | None = None,
    word: str = "made",
) -> None:
    """Make the files of every input.

    An only input is reported by `print_result` (default: the names of its files), and fails as any command does.
    Several inputs get a line each, a progress bar and a summary, and end with the worst of their exit codes.

    Parameters
    ----------
    action, unit : words of the progress bar: "reducing", "rows".
    inputs : files, see `files_of`.
    make : makes the files of one input.
    word : what is said of an input that is not unchanged.

    Raises
    ------
    ProcessError : the only input fails.
    typer.Exit : one of several failed.
    """
    if len(inputs) == 1:
        with progress_bar(action, unit) as tick:
            output = make(inputs[0], tick)
        if print_result is None:
            typer.echo("\n".join(map(str, output.paths)))
        else:
            print_result(output)
        if output.is_unchanged:
            typer.echo("unchanged: made before of the same inputs with the same options")
        return
    counts = {word: 0, "unchanged": 0, "failed": 0}
    failures: list[str] = []
    worst = 0
    with batch_bar(action, len(inputs)) as bar:
        for path in inputs:
            try:
                output = make(path, bar.tick)
            except Exception as error:  # noqa: BLE001  # whatever is wrong with one input, the others are done
                text, code = reason_of(path, error)
                failures.append(text)
                worst = max(worst, code)
                counts["failed"] += 1
                bar.finish(f"failed     {text}", failed=True)
                continue
            result = "unchanged" if output.is_unchanged else word
            counts[result] += 1
            more = f" and {len(output.paths) - 1} more" if len(output.paths) > 1 else ""
            bar.finish(f"{result:10} {output.paths[0]}{more}{output.facts}")
    typer.echo(f"{len(inputs)} inputs: " + ", ".join(f"{number} {result}" for result, number in counts.items()))
    if worst:
        typer.echo("\n".join(["failed:", *(f"  {text}" for text in failures)]), err=True)
        raise typer.Exit(worst)


def make_products(
    action: str,
    unit: str,
    inputs: Sequence[Path],
    step_of: Callable[[Path, Progress], tuple[FileStep, StepProduct | None]],
    *,
    out: Path | None,
    overwrite: bool,
    figure: Path | None,
    no_figure: bool,
) -> None:
    """`run_batch` for steps: each input gets its product and a figure; a product that exists is not made again.

    Parameters
    ----------
    step_of : the step of an input, and the product that it starts from where a capture is reduced first.

    Raises
    ------
    ProcessError : `out` or `figure` is one file for several inputs, or the only input fails.
    """
    several = len(inputs) > 1
    if several and figure is not None:
        raise ProcessError(f"--figure {figure}: one file for {len(inputs)} inputs. Leave it out: each gets its own.")
    place = place_for(inputs, out)
    first: list[StepProduct] = []
    sources: dict[str, Path] = {}

    def make(source: Path, tick: Progress) -> Output:
        step, start = step_of(source, tick)
        target = place(step.usual_path)
        if (first_source := sources.setdefault(os.path.realpath(target), source)) != source:
            raise ProcessError(f"its product {target} is that of {first_source} too. Rename one of them.")
        product = step.kept_or_made(target, overwrite, tick)
        if not several:
            first.extend([start] if start else [])
            return Output((product.path,), product.existed)
        for result in (start, product):
            if result is not None and not (result is start and result.existed):
                print_warnings(result.path, f"{result.path.name}: ")
        if not (product.existed and product.path.with_suffix(".png").exists()):
            draw(product.path, None, no_figure, silent=True)
        return Output((product.path,), product.existed, one_line(product.path))

    def print_result(output: Output) -> None:
        for start in first:
            typer.echo(f"using {start.path}") if start.existed else summary(start.path)
        summary(output.paths[0])
        draw(output.paths[0], figure, no_figure)

    run_batch(action, unit, inputs, make, print_result=print_result)


def place_for(inputs: Sequence[Path], out: Path | None) -> Callable[[Path], Path]:
    """Where files go: `out` in place of the usual name; a folder `out`, made if need be, takes the usual names.

    Raises ProcessError: `out` is the name of a file, and there are several inputs.
    """
    if out is None:
        return lambda usual: usual
    if len(inputs) == 1 and not out.is_dir():
        return lambda usual: out
    if out.suffix or out.is_file():
        raise ProcessError(f"--out {out}: one file for {len(inputs)} inputs. Give a folder: --out {out.stem}")
    out.mkdir(parents=True, exist_ok=True)
    return lambda usual: out / usual.name


def write_if_changed(target: Path, overwrite: bool, write: Callable[[Path], Sequence[Path]]) -> Output:
    """Files for other programs, which do not record their inputs: written again, and compared byte for byte.

    Parameters
    ----------
    target : name of the file, or the beginning of the names of several.
    write : writes the files under a name in another folder, and returns them.

    Raises
    ------
    ProcessError : a file exists with other bytes, and `overwrite` is false.
    """
    from processing.doors import require_folder, require_place

    require_folder(target)
    with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        written = write(Path(folder) / target.name)
        targets = [target.with_name(path.name) for path in written]
        pairs = list(zip(written, targets, strict=True))
        if all(old.is_file() and filecmp.cmp(new, old, shallow=False) for new, old in pairs):
            return Output(tuple(targets), True)
        for path in targets:
            require_place(path, overwrite)
        for new, old in pairs:
            os.replace(new, os.path.realpath(old))
    return Output(tuple(targets), False)


def files_of(
    sources: Sequence[Path], takes: Callable[[Path], bool], text: str, endings: Sequence[str] = (".h5",)
) -> list[Path]:
    """Files that are given, and those under folders that are given, in natural order (2 before 10), each once.

    Parameters
    ----------
    takes : whether the command is for a file; asked of those in folders. One that cannot be read is taken as well: the
        command then reports it.
    text : what it is for, for the message where a folder holds nothing of it: "captures".

    Raises
    ------
    ProcessError : a folder holds nothing to take.
    """
    files: list[Path] = []
    for source in sources:
        if not source.is_dir():
            files.append(source)
            continue
        inside = [p for ending in endings for p in source.rglob(f"*{ending}") if p.is_file() and _shown(p, source)]
        selection = [p for p in sorted(inside, key=natural) if _takes(takes, p)]
        if not selection:
            raise ProcessError(f"{source} holds no {text}. Give files, or the folder that they are in.")
        files += selection
    return list({os.path.realpath(path): path for path in files}.values())


def captures_and(products: Iterable[str]) -> Callable[[Path], bool]:
    """For `files_of`: captures that reduce to one of these kinds of product, and products without their capture."""
    from processing.storage.captures.capture import Capture, made_of_captures
    from processing.storage.products.product import Product, is_product

    kinds = set(products)

    def takes(path: Path) -> bool:
        if not made_of_captures(path):
            with Capture(path) as capture:
                return capture.reduces_to in kinds
        if not is_product(path):
            return False
        with Product(path) as product:
            return product.kind in kinds and not _capture_is_near(path)

    return takes


def _capture_is_near(product: Path) -> bool:
    """Whether the capture of NAME.KIND.h5 is in the folder: the command then starts from that."""
    words = product.name.split(".")
    return any(product.with_name(f"{'.'.join(words[:k])}.h5").exists() for k in range(1, len(words) - 1))


def _takes(takes: Callable[[Path], bool], path: Path) -> bool:
    try:
        return takes(path)
    except ProcessError:
        return True


def _shown(path: Path, folder: Path) -> bool:
    return not any(part.startswith(".") for part in path.relative_to(folder).parts)


def natural(path: Path) -> list[tuple[bool, int, str]]:
    return [
        (not word.isdecimal(), int(word) if word.isdecimal() else 0, word) for word in re.split(r"(\d+)", str(path))
    ]


def reason_of(path: Path, error: Exception) -> tuple[str, int]:
    """Words and exit code of a failure, as `command_line.run` has them for a command with one input."""
    text, code = " ".join(str(error).split()), 1
    if isinstance(error, ProcessError):
        code = error.exit_code
    elif isinstance(error, FileNotFoundError):
        text, code = f"{error.filename}: no such file or folder", 2
    elif not isinstance(error, OSError):
        text = f"{type(error).__name__}: {text}. This is a fault of the program; run it for this file alone."
    return (text if str(path) in text else f"{path}: {text}"), code
