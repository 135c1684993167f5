"""Starts the guard of a rig and beats for it (acquisition/rig/guard.py)."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.rig.stop_axes import has_own_emulators
from drivers.errors import DeviceError
from processing.yaml_file import dump_yaml

#: Time between two beats.
BEAT_S = 0.1
#: Longest wait for the guard to note its end.
END_S = 2.0


@contextlib.contextmanager
def guarded(config: RigConfig, folder: Path) -> Iterator[None]:
    """Have an open rig watched from outside; emulators that end with this process need no guard.

    Parameters
    ----------
    folder : where the guard writes `guard.jsonl`.
    """
    if has_own_emulators(config):
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    guard = subprocess.Popen(
        [sys.executable, "-m", "acquisition.rig.guard"],
        stdin=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    )
    beating = threading.Event()
    heart = threading.Thread(target=_beat, args=(guard, beating), name="heartbeat", daemon=True)
    try:
        _say(guard, json.dumps({"rig": dump_yaml(config), "pid": os.getpid(), "log": str(folder / "guard.jsonl")}))
        heart.start()
        yield
    except (AcquisitionError, DeviceError) as error:
        _say(guard, "failed " + str(error).replace("\n", " "))
        raise
    finally:
        beating.set()
        heart.join()
        _say(guard, "rest")
        with contextlib.suppress(OSError):
            guard.stdin.close()  # type: ignore[union-attr]
        try:
            guard.wait(END_S)
        except subprocess.TimeoutExpired:
            guard.kill()
            guard.wait()


def _beat(guard: subprocess.Popen[bytes], ended: threading.Event) -> None:
    number = 0
    while not ended.wait(BEAT_S):
        number += 1
        _say(guard, f"beat {number}")


def _say(guard: subprocess.Popen[bytes], line: str) -> None:
    # A guard that is gone must not end the measurement.
    with contextlib.suppress(OSError, ValueError):
        assert guard.stdin is not None
        guard.stdin.write(line.encode() + b"\n")
        guard.stdin.flush()
