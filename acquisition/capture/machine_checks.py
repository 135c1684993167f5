"""What a rig file names on the machine that it is used on: programs to call somebody, files of the emulated bench.

The rig file is sound without them, and can be read, resumed from and stopped by on another machine; no run begins.
"""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from acquisition.capture.checks import CheckResult
from acquisition.rig.config import RigConfig
from processing.errors import ProcessError


def check_machine(rig: RigConfig, samples: Iterable[str] | None = None) -> list[CheckResult]:
    """Programs of `alert` and `notify`, and files that an emulated bench needs for these samples, or for all."""
    checks = []
    commands = {"alert": rig.alert, "notify": rig.notify.command if rig.notify else ()}
    for key, command in commands.items():
        if command:
            program = shutil.which(command[0])
            lacking = f"there is no program {command[0]!r} here: nobody would be called"
            checks.append(CheckResult(key, program is not None, program or lacking))
    return [*checks, *(_check_file(*file) for file in rig.bench_files(samples))]


def _check_file(title: str, path: Path, load: Callable[[Path], object]) -> CheckResult:
    try:
        load(path)
    except ProcessError as error:
        return CheckResult(title, False, str(error))
    return CheckResult(title, True, str(path))
