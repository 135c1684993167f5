"""Kills `acquire` before each of its calls that change the disc, and cuts the power at each of them.

    python tests/faults/kill_points.py kill [EVERY [FIRST]]     each (or every n-th) call of a small campaign
    python tests/faults/kill_points.py error [EVERY [FIRST]]    each call fails with an input/output error instead
    python tests/faults/kill_points.py power [CUTS]             states of the disc after a power cut, replayed

After each kill the same command goes on. At its end every capture must be complete and equal to that of an undisturbed
run in all but times and segments, and `acquire verify` must find nothing. Exit code 1 if anything is lost.
"""

import contextlib
import ctypes
import fcntl
import hashlib
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from simulated_rig import write_rig

# Imported once here, not anew in each child:
import acquisition.commands.campaign  # noqa: F401
import acquisition.screen.quicklook  # noqa: F401
import processing.reflectance.material_fit  # noqa: F401
from acquisition.commands.application import main as acquire
from acquisition.commands.custody import verify
from processing.storage.captures.capture import Capture, CaptureError
from simulators.disc.power_cut import UnreliableDisc, read_record
from simulators.disc.watched import RECORD, DiscCalls, build, restart_watched

ROOT = Path(__file__).resolve().parents[2]
WORK = Path(tempfile.gettempdir()) / f"umov_kill_points_{os.getuid()}"
#: Of prctl: processes whose parent has ended become children of this one.
PR_SET_CHILD_SUBREAPER = 36
#: What differs between two runs of one plan.
TIMES = ("host_time_s", "camera_time_ns", "frame_id", "start_time", "closing/json", "segments/json", "segment", "crc32")


def write_files(folder: Path) -> list[str]:
    """Rig, plan and campaign of a small capture; returns the options of `acquire`."""
    quick = {"rows": 16, "columns": 20, "clock_speed": 200, "camera_wait_s": 60}
    write_rig(folder / "rig.yaml", quick, settle_s=0.0)
    (folder / "plan.yaml").write_text(
        "kind: plan\nmode: stokes\nwavelength_nm: 662\nomega_deg: 35\nsample: {name: red_sphere}\n"
        "states: {kind: fixed, states: 3}\nexposure_s: 0.001\ndarks: 1\n"
    )
    (folder / "campaign.yaml").write_text(
        f"kind: campaign\nname: night\nplans: {{stokes: {folder / 'plan.yaml'}}}\nsamples: [{{name: red_sphere}}]\n"
        f"wavelengths_nm: [662]\nomega_deg: [20]\n"
    )
    return ["--campaign", str(folder / "campaign.yaml"), "--rig", str(folder / "rig.yaml"), "--yes"]


def run(options: list[str], out: Path, before: Callable[[DiscCalls], None] = lambda calls: None) -> tuple[int, int]:
    """`acquire` in a child; returns what `waitpid` says and, if it came to its end, the number of its calls."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with open(os.devnull, "w") as null:
            os.dup2(null.fileno(), 1)
            os.dup2(null.fileno(), 2)
        calls, code = DiscCalls(), 70
        before(calls)
        try:
            acquire([*options, "--out", str(out)])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
        finally:
            os.write(writer, str(calls.made()).encode())
            os._exit(code)
    os.close(writer)
    status = os.waitpid(child, 0)[1]
    wait_for_orphans()
    with os.fdopen(reader) as pipe:
        count = pipe.read()
    return status, int(count or 0)


def wait_for_orphans() -> None:
    """Wait for the disc process of what has ended, which becomes a child of this program; it dies a moment later."""
    with contextlib.suppress(ChildProcessError):
        while True:
            os.waitpid(-1, 0)


def content(capture: Path) -> dict[str, bytes]:
    """Digests of everything in a capture but times."""
    digests: dict[str, bytes] = {}

    def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
        if isinstance(node, h5py.Dataset) and not name.endswith(TIMES):
            value = np.asarray(node[()])
            raw = str(value).encode() if value.dtype == object else value.tobytes()
            digests[name] = hashlib.blake2b(raw).digest()

    with h5py.File(capture) as h5:
        h5.visititems(visit)
    return digests


def contents(folder: Path) -> dict[str, bytes]:
    """Digests of all captures of a campaign."""
    return {
        f"{path.name}/{name}": digest
        for path in sorted((folder / "night").glob("*.h5"))
        for name, digest in content(path).items()
    }


def check(out: Path, expected: dict[str, bytes]) -> str:
    """What is wrong with a campaign that came to its end, or nothing."""
    wrong = [f"{f.title}: {f.detail}" for f in verify(out / "night") if f.well is not True]
    result = contents(out)
    differing = sorted(name for name in {*expected, *result} if expected.get(name) != result.get(name))
    if differing:
        wrong.append(f"differs from an undisturbed run in {differing[:5]}")
    return "; ".join(wrong)


def kill(options: list[str], stride: int, first: int, fails: bool) -> int:
    """Kill before every n-th call, or have it fail, go on, compare."""
    captures = WORK / "captures"
    status, total = run(options, captures / "whole", lambda calls: calls.arm(0))
    assert status == 0, status
    expected = contents(captures / "whole")
    lost = points = 0
    begin_s = time.monotonic()
    for number in range(first, total + 1, stride):
        out = captures / f"run{number}"
        at = {"number": 0, "failing": number} if fails else {"number": number}
        status, _ = run(options, out, lambda calls, at=at: calls.arm(**at))
        # An error is told with exit code 1, but where it concerns nothing that matters, as the figure of a capture.
        killed = status != 0
        crashed = "" if not fails or not os.WIFSIGNALED(status) else f"crashed with signal {os.WTERMSIG(status)}"
        status, _ = run(options, out)
        wrong = crashed or (check(out, expected) if status == 0 else f"going on ended with {status}")
        points += killed
        if wrong:
            lost += 1
            print(f"call {number}: {wrong}", flush=True)
        shutil.rmtree(out)
    kind = "errors told" if fails else "kill points"
    print(f"{points} {kind} of {total} calls, {lost} with something lost, {time.monotonic() - begin_s:.0f} s")
    return lost


class _Reported:
    """Says in the record when a state is reported as done."""

    def __init__(self, calls: DiscCalls) -> None:
        from acquisition.screen.progress import ConsoleProgress

        inner = ConsoleProgress.state_done

        def state_done(progress: ConsoleProgress, report: object) -> None:
            inner(progress, report)  # type: ignore[arg-type]
            calls.note("state")

        ConsoleProgress.state_done = state_done  # type: ignore[method-assign,assignment]


def power(options: list[str], cuts: int, seed: int = 1) -> int:
    """Replay the record of a run to chosen calls, cut the power there, and look what is left."""
    out, record = WORK / "captures" / "whole", WORK / "record"

    def begin(calls: DiscCalls) -> None:
        os.environ[RECORD] = str(record)
        _Reported(calls)
        calls.arm(0)

    status, _ = run(options, out, begin)
    assert status == 0, status
    calls = list(read_record(record))
    chance = random.Random(seed)
    chosen = sorted(chance.choices(range(1, len(calls) + 1), k=cuts)) if cuts else list(range(1, len(calls) + 1))
    disc, done, reported, lost, worst, opened = UnreliableDisc(), 0, 0, 0, 0, 0
    looked: dict[int, tuple[int, str]] = {}
    for end in chosen:
        for call in calls[done:end]:
            disc.apply(call)
            reported += call.kind == "note"
        done = end
        for cache in (None, random.Random(chance.random())):
            files = disc.after_power_cut(cache)
            # Between two syncs the disc is sure of the same files.
            key = hash(frozenset(files.items()))
            if key not in looked:
                target = WORK / "cut"
                shutil.rmtree(target, ignore_errors=True)
                for path, raw in files.items():
                    file = target / Path(path).relative_to(out)
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_bytes(raw)
                looked[key] = _left(target / "night")
            states_on_disc, unreadable = looked[key]
            opened += 1
            worst = max(worst, reported - states_on_disc)
            if reported - states_on_disc > 1 or unreadable:
                lost += 1
                print(
                    f"cut at call {end}: {reported} states reported, {states_on_disc} there; {unreadable}", flush=True
                )
    print(f"{opened} power cuts at {len(calls)} calls: at most {worst} reported states lost, {lost} beyond the bound")
    return lost


def _left(folder: Path) -> tuple[int, str]:
    """States that are there and intact, and what cannot be read."""
    states, unreadable = 0, ""
    for path in sorted(folder.glob("*")) if folder.exists() else ():
        if not path.name.endswith((".h5", ".partial")):
            continue
        try:
            with Capture(path) as capture:
                states += len(capture.done)
                damaged = capture.damaged_states()
                unreadable += f"{path.name}: states {damaged} damaged " if damaged else ""
        except CaptureError as error:
            unreadable += f"{error} "
    return states, unreadable


def main() -> None:
    """Run one of the three."""
    mode, numbers = sys.argv[1], [int(text) for text in sys.argv[2:]]
    if "LD_PRELOAD" not in os.environ:
        # Two at once would read each other's records. The lock goes on into the program that takes this one's place.
        lock = os.open(f"{WORK}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        os.set_inheritable(lock, True)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SystemExit(f"another run uses {WORK}. Wait for its end.") from None
        shutil.rmtree(WORK, ignore_errors=True)
        (WORK / "captures").mkdir(parents=True, exist_ok=True)
        restart_watched(build(WORK), WORK / "captures")
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    options = write_files(WORK)
    if mode == "power":
        lost = power(options, (numbers or [0])[0])
    else:
        stride, first = [*numbers, *(1, 1)[len(numbers) :]][:2]
        lost = kill(options, stride, first, fails=mode == "error")
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
