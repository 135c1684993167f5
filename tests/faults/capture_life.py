"""A capture that is begun, ended in any way, resumed and offered other devices, in any order: a state machine.

    python tests/faults/capture_life.py [EXAMPLES]

Each run is `acquire` in a child of its own, which ends by itself, is stopped, fails, loses its disc process or is
killed at a drawn moment. Exit code 1 and the shortest order of steps that was found, if a promise is broken.
"""

import ctypes
import json
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import hypothesis.strategies as st

# Imported once here, not anew in each child.
import matplotlib.backends.backend_agg  # noqa: F401
import matplotlib.figure  # noqa: F401
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from kill_points import PR_SET_CHILD_SUBREAPER, content, wait_for_orphans
from simulated_rig import write_rig

from acquisition.commands.application import main as acquire
from acquisition.disc import disc
from acquisition.screen.progress import ConsoleProgress
from drivers.errors import DeviceError
from processing.storage.captures.capture import Capture
from simulators.controllers import zaber
from simulators.rig.rig import SimulatedRig


def _fail(error: Exception) -> None:
    raise error


def _send(*signals: int) -> None:
    for number in signals:
        os.kill(os.getpid(), number)


#: How a run may end at the moment that was drawn.
ENDS: dict[str, Callable[[], None]] = {
    "stopped": lambda: _send(signal.SIGINT),
    "stopped at once": lambda: _send(signal.SIGINT, signal.SIGINT),
    "a device fails": lambda: _fail(DeviceError("a device", "broke", "Mend it")),
    "unforeseen": lambda: _fail(MemoryError("injected")),
    "disc process killed": lambda: os.kill(disc().pid, signal.SIGKILL),
    "killed": lambda: _send(signal.SIGKILL),
}
MOMENTS = ("exposing", "state_done")


def run(options: list[object], end: str = "", moment: str = "", number: int = 0) -> dict[str, Any]:
    """`acquire` in a child that ends at the n-th such moment; what it reported, said and left switched on."""
    with tempfile.TemporaryFile("w+") as output:
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            code = 70
            rigs: list[SimulatedRig] = []
            _watch(end, moment, number, rigs=rigs, tell=lambda state: os.write(writer, f"{state}\n".encode()))
            try:
                acquire([str(option) for option in options])
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else 0
            finally:
                os.write(writer, (json.dumps({"light": [rig.light() for rig in rigs]}) + "\n").encode())
                os._exit(code)
        os.close(writer)
        with os.fdopen(reader) as pipe:
            lines = [json.loads(line) for line in pipe]
        status = os.waitpid(child, 0)[1]
        wait_for_orphans()
        output.seek(0)
        words = output.read()
    light = lines.pop()["light"] if lines and isinstance(lines[-1], dict) else []
    return {"code": os.waitstatus_to_exitcode(status), "reported": lines, "light": light, "said": words}


def _watch(end: str, moment: str, number: int, *, rigs: list[SimulatedRig], tell: Callable[[int], object]) -> None:
    """Make this process end at its moment, and report each state that a user is told of; nothing is undone."""
    calls, start = count(1), SimulatedRig.start

    def watched(name: str) -> Callable[..., None]:
        inner = getattr(ConsoleProgress, name)

        def hear(progress: ConsoleProgress, *details: Any) -> None:
            inner(progress, *details)
            if name == "state_done":
                tell(details[0].state)
            if name == moment and next(calls) == number:
                ENDS[end]()

        return hear

    def started(rig: SimulatedRig) -> None:
        rigs.append(rig)
        start(rig)

    SimulatedRig.start = started  # type: ignore[method-assign]
    for name in MOMENTS:
        setattr(ConsoleProgress, name, watched(name))


class LifeOfACapture(RuleBasedStateMachine):
    """What was reported is in the file, once and unchanged; a capture that is complete equals an undisturbed one."""

    undisturbed: ClassVar[dict[tuple[int, int], dict[str, bytes]]] = {}

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="umov_life_"))
        self.known: dict[int, bytes] = {}
        self.reported: set[int] = set()
        self.missing = 0

    @property
    def file(self) -> Path | None:
        """The capture, partial or not; there is one at most."""
        files = [path for path in (self.folder / "out").glob("*") if path.name.endswith((".h5", ".partial"))]
        assert len(files) <= 1, files
        return files[0] if files else None

    @property
    def partial(self) -> bool:
        """Whether there is something to resume."""
        return self.file is not None and self.file.suffix == ".partial"

    @initialize(states=st.integers(2, 4), darks=st.integers(0, 1))
    def plan(self, states: int, darks: int) -> None:
        """Write rig and plan; take the same capture undisturbed, once."""
        write_rig(
            self.folder / "rig.yaml", {"rows": 16, "columns": 20, "clock_speed": 200, "camera_wait_s": 60}, settle_s=0.0
        )
        angles = ", ".join(f"{20.0 * k}" for k in range(states))
        (self.folder / "plan.yaml").write_text(
            "kind: plan\nmode: stokes\nwavelength_nm: 662\nomega_deg: 35\nsample: {name: red_sphere}\n"
            f"states: {{kind: table, angles: {{psa: [{angles}]}}}}\nexposure_s: 0.001\ndarks: {darks}\n"
        )
        self.kind = (states, darks)
        if self.kind not in self.undisturbed:
            self._acquire(folder="whole")
            (complete,) = (self.folder / "whole").glob("*.h5")
            self.undisturbed[self.kind] = content(complete)

    def _acquire(self, end: str = "", moment: str = "", number: int = 0, folder: str = "out") -> dict[str, Any]:
        first = ["--plan", self.folder / "plan.yaml", "--out", self.folder / folder]
        options = ["--resume", self.file] if folder == "out" and self.file else first
        return run([*options, "--rig", self.folder / "rig.yaml"], end, moment, number)

    @rule(end=st.sampled_from(sorted(ENDS)), moment=st.sampled_from(MOMENTS), number=st.integers(1, 5))
    def take(self, end: str, moment: str, number: int) -> None:
        """Begin the capture, or resume it; the run may end too early. There is nothing to resume of a complete one."""
        if self.file is not None and not self.partial:
            self._refused("there is nothing to resume", code=1)
            return
        ended = self._acquire(end, moment, number)
        killed = ended["code"] == -signal.SIGKILL
        assert killed <= (end == "killed"), ended["said"]
        assert ("Traceback" in ended["said"]) <= (end == "unforeseen"), ended["said"]
        new = set(ended["reported"])
        assert len(new) == len(ended["reported"]), ended["reported"]
        assert not new & self.known.keys(), "a state that the file has was taken again"
        self.reported |= new
        if not killed:
            assert not any(ended["light"])
        # What was reported last is on its way to the disc process when this is killed, or that one.
        self._look(lost=killed or end == "disc process killed")
        if ended["code"] == 0:
            assert not self.partial

    def _look(self, lost: bool) -> None:
        if self.file is None:
            assert not self.known
            return
        with Capture(self.file) as capture:
            assert not capture.damaged_states()
            done = [int(state) for state in capture.done]
            self.missing = len(capture.planned_column("exposure_s")) - len(done)
            values = [capture.column(name) for name in ("host_time_s", "exposure_s", "segment")]
            content = {
                state: capture.frames(k).tobytes() + b"".join(column[k].tobytes() for column in values)
                for k, state in enumerate(done)
            }
            run_of = dict(zip(done, capture.column("segment"), strict=True))
            runs = len(capture.segments)
            states = [state for segment in capture.segments for state in segment.states]
        assert {state: content.get(state) for state in self.known} == self.known
        assert len(self.reported - content.keys()) <= lost, (self.reported, done)
        assert len(set(states)) == len(states), states
        assert {run_of[state] for state in content.keys() - self.known.keys()} <= {runs - 1}
        self.known, self.reported = content, set(content)

    @rule()
    def swap_a_device(self) -> None:
        """With rotators of other serial numbers a resume is refused, and nothing happens."""
        # What a kill leaves is not the same each time: no precondition, which Hypothesis asks anew.
        # Where no state is missing, the file is sealed on any rig.
        if not self.partial or not self.missing:
            return
        device_class = zaber.ZaberDevice

        def other(*arguments: Any, serial_number: int, **options: Any) -> zaber.ZaberDevice:
            return device_class(*arguments, serial_number=serial_number + 1000, **options)

        zaber.ZaberDevice = other  # type: ignore[misc,assignment]
        try:
            self._refused("psa.serial_number: 110002 at the start, 111002 now", code=2)
        finally:
            zaber.ZaberDevice = device_class  # type: ignore[misc]

    def _refused(self, words: str, code: int) -> None:
        assert self.file is not None
        before = self.file.read_bytes()
        ended = self._acquire()
        assert ended["code"] == code, ended
        assert words in ended["said"], ended["said"]
        assert not ended["reported"]
        assert not any(ended["light"])
        assert self.file.read_bytes() == before

    def teardown(self) -> None:
        """Whatever happened, the same command ends it."""
        if hasattr(self, "kind"):
            if self.file is None or self.partial:
                self.take("", "", 0)
            assert self.file is not None
            assert content(self.file) == self.undisturbed[self.kind]
        shutil.rmtree(self.folder)


def main() -> None:
    """Run the state machine; its ends and alarms are not those of whoever tests."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    examples = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    # The same every time where examples are few.
    chosen = settings(max_examples=examples, derandomize=examples < 100, phases=(Phase.generate, Phase.shrink))
    chosen = settings(chosen, stateful_step_count=4, deadline=None, database=None, suppress_health_check=[*HealthCheck])
    with tempfile.TemporaryDirectory() as home:
        os.environ |= dict.fromkeys(("XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"), home)
        run_state_machine_as_test(LifeOfACapture, settings=chosen)


if __name__ == "__main__":
    main()
