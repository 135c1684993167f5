"""Counts the calls of this process that change a folder, and has one of them be the last (disc_calls.c)."""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).with_name("disc_calls.c")
FOLDER = "UMOV_DISC_FOLDER"
RECORD = "UMOV_DISC_LOG"


def compiler() -> str | None:
    """The C compiler of this machine, if it has one."""
    return shutil.which("cc") or shutil.which("gcc")


def build(folder: Path) -> Path:
    """Compile the library into a folder. Raises RuntimeError without a C compiler."""
    cc = compiler()
    if cc is None:
        raise RuntimeError("there is no C compiler (cc or gcc): disc calls cannot be watched")
    library = folder / "disc_calls.so"
    subprocess.run([cc, "-O1", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl", "-lpthread"], check=True)
    return library


def environment(library: Path, folder: Path) -> dict[str, str]:
    """Environment of a program whose changes below `folder` are watched."""
    return os.environ | {"LD_PRELOAD": str(library), FOLDER: str(folder)}


def restart_watched(library: Path, folder: Path) -> None:
    """Have this program begin again, watched; returns if it is watched already."""
    if os.environ.get(FOLDER) != str(folder):
        os.execve(sys.executable, [sys.executable, *sys.argv], environment(library, folder))


class DiscCalls:
    """The library as it is loaded into this process."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(None)
        self._library.disc_calls_made.restype = ctypes.c_long

    def arm(self, number: int, failing: int = 0) -> None:
        """Count from zero, and kill this process before the call of that number; 0 for never.

        The call of number `failing` fails with an input/output error, if it is one of a file that is open.
        """
        self._library.disc_calls_arm(ctypes.c_long(number), ctypes.c_int(signal.SIGKILL), ctypes.c_long(failing))

    def made(self) -> int:
        """Calls since `arm`."""
        return int(self._library.disc_calls_made())

    def note(self, text: str) -> None:
        """Add a remark to the record."""
        self._library.disc_calls_note(text.encode())
