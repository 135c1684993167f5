"""Runs of `acquire` in a process of their own, to be killed, stopped and starved; and how captures compare."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.commands import exit_code

#: What may differ between two runs of one plan: times, the camera's own count of its frames, and who took which state.
TIMES = {"host_time_s", "camera_time_ns", "frame_id", "start_time", "closing/json"}
#: How HDF5 keeps dimension scales: references, which differ from file to file.
LINKS = {"DIMENSION_LIST", "REFERENCE_LIST"}
TIMES |= {"segments/json", "states/segment", "states/crc32"}
#: A dark and 18 poses: what `run_with` takes unless its test says otherwise.
SHORT = {"states": {"kind": "rotating_retarders", "states": 18, "step_deg": 20, "ratio": 4.91}, "darks": 1}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A promise run in full takes its time: no limit for a single test then."""
    if "UMOV_FAULT_RUNS" in os.environ or "UMOV_FAULTS" in os.environ:
        for item in items:
            item.add_marker(pytest.mark.timeout(0))


@pytest.fixture
def runs() -> int:
    """Repetitions of a random fault: few in CI; UMOV_FAULT_RUNS=50 for the full promise."""
    return int(os.environ.get("UMOV_FAULT_RUNS", "1"))


@pytest.fixture
def spawn() -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts `acquire` in a child process; what is left of it is killed at the end."""
    children = []

    def start(*arguments: object, **keywords: object) -> subprocess.Popen:
        child = subprocess.Popen(
            [sys.executable, "-m", "acquisition.commands.application", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **keywords,
        )
        children.append(child)
        return child

    yield start
    for child in children:
        child.kill()
        child.communicate()


@pytest.fixture
def partial_of() -> Callable[..., Path]:
    """Waits until the child's partial file holds at least so many states done."""

    def wait(folder: Path, child: subprocess.Popen, states: int = 0) -> Path:
        while True:
            partials = list(folder.glob("*.partial"))
            if partials and (states == 0 or _states_done(partials[0]) >= states):
                return partials[0]
            if child.poll() is not None:
                raise AssertionError(f"the run ended early: {child.communicate()}")
            time.sleep(0.01)

    return wait


def _states_done(path: Path) -> int:
    # HDF5 locks the file while it is written; reading without the lock is good enough to see how far it is.
    try:
        with h5py.File(path, "r", locking=False) as file:
            return int(np.count_nonzero(file["entry/states/done"][...]))
    except (OSError, KeyError, RuntimeError):
        return 0


@pytest.fixture
def content() -> Callable[[Path], dict[str, object]]:
    """Everything in a capture but times."""

    def read(path: Path) -> dict[str, object]:
        items: dict[str, object] = {}

        def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
            for key in node.attrs.keys() - LINKS:
                value = node.attrs[key]
                items[f"{name}@{key}"] = value if np.isscalar(value) else np.asarray(value).tolist()
            if isinstance(node, h5py.Dataset) and not any(name.endswith(time) for time in TIMES):
                items[name] = node[...].tobytes() if node.dtype.kind != "O" else np.asarray(node[()]).tolist()

        with h5py.File(path) as file:
            visit("entry", file["entry"])
            file["entry"].visititems(visit)
        return items

    return read


@pytest.fixture
def quick_rig(small_rig: Callable[..., Path]) -> Callable[..., Path]:
    """A rig for fault runs, its frames stamped with the true angles."""

    def make(name: str = "rig.yaml", top: dict | None = None, **simulator: object) -> Path:
        return small_rig(name, top=top, **({"stamp": True} | simulator))

    return make


@pytest.fixture
def intact(configs: Path) -> Callable[[Path], int]:
    """Checks every state done of a capture: whole frame, true angles in its pixels; returns their number."""
    from processing.storage.captures.capture import Capture
    from simulators.camera.pixel_stamp import read_stamp

    def check(path: Path) -> int:
        with Capture(path) as capture:
            # The stamp holds every axis of the rig; a Stokes capture records those that it sets.
            axes = ("arm", "psa", "psg")
            for state in range(len(capture.done)):
                true = dict(zip(axes, read_stamp(capture.frames(state)[0]), strict=True))
                for axis in capture.angles_deg:
                    off_deg = true[axis] - float(capture.angles_deg[axis][state])
                    # A rotator that was homed again counts its turns anew: its switch comes once a turn.
                    off_deg = off_deg if axis == "arm" else math.remainder(off_deg, 360.0)
                    assert abs(off_deg) < 5e-4, (state, axis, true[axis], off_deg)
            return len(capture.done)

    return check


@pytest.fixture
def plan_file(tmp_path: Path) -> Path:
    """The plan of `run_with` as a file, with smaller steps: for programs whose rig moves slowly."""
    path = tmp_path / "plan.yaml"
    path.write_text("kind: plan\nstates: {kind: rotating_retarders, states: 18, step_deg: 10, ratio: 4.91}\ndarks: 1\n")
    return path


@pytest.fixture
def run_with(quick_rig: Callable[..., Path], tmp_path: Path) -> Callable[..., tuple[BaseException | None, Path]]:
    """Runs a capture in this process and does something to the rig when a state is about to be exposed.

    The plan is `SHORT`, with the changes of `plan`.
    `act(rig, state, retake)` is called before each exposure. Returns the error that ended the run, or None, and the
    file, partial or not.
    """
    from acquisition.capture import session
    from acquisition.capture.job import check_with_devices, prepare
    from acquisition.capture.plan import MeasurementPlan
    from acquisition.disc import disc_process
    from acquisition.errors import AcquisitionError
    from acquisition.rig.config import load_rig
    from acquisition.rig.open_rig import open_rig
    from acquisition.screen.observer import Observer
    from acquisition.stop_request import StopRequest
    from drivers.errors import DeviceError

    numbers = iter(range(1000))

    def run(
        act: Callable[..., None] = lambda *_: None,
        plan: dict | None = None,
        top: dict | None = None,
        resume: Path | None = None,
        observers: tuple = (),
        **simulator: object,
    ) -> tuple[BaseException | None, Path]:
        config = load_rig(quick_rig(top=top, **simulator))
        job = prepare(MeasurementPlan().with_changes(**(SHORT | (plan or {}))), config)
        folder = tmp_path / f"capture{next(numbers)}" if resume is None else resume.parent
        error: BaseException | None = None
        with disc_process(), open_rig(config) as rig:

            class Act(Observer):
                def exposing(self, state: int, retake: int) -> None:
                    act(rig, state, retake)

            watchers = [Act(), *observers]
            try:
                check_with_devices(job, rig, folder)
                if resume is None:
                    session.take(job, rig, folder / "run.h5", StopRequest(), observers=watchers)
                else:
                    session.resume(job, rig, resume, StopRequest(), observers=watchers)
            except (AcquisitionError, DeviceError) as caught:
                error = caught
        return error, next(path for path in sorted(folder.glob("run.h5*")) if path.suffix != ".png")

    return run


@pytest.fixture
def refused(tmp_path):
    """Runs a command and asks that it refuses its input as promised; returns what it said."""

    def run(main, *arguments):
        start_s = time.process_time()
        assert exit_code(main, *arguments) == 2
        assert time.process_time() - start_s < 5

    return run


@pytest.fixture
def error_text(refused, capfd):
    """Runs a command that refuses its input; returns what it says, in lines that can be read."""

    def run(main, *arguments):
        refused(main, *arguments)
        err = capfd.readouterr().err
        assert "Traceback" not in err
        assert all(len(line) < 1000 for line in err.splitlines())
        return err

    return run


@pytest.fixture
def acquire_refuses(error_text):
    from acquisition.commands.application import main

    return partial(error_text, main)


@pytest.fixture
def process_refuses(error_text):
    from processing.commands.application import main

    def run(*arguments):
        err = error_text(main, *arguments)
        assert len(err.splitlines()) == 1, err
        return err

    return run
