"""Whether the light goes off: promise x fault x survived, with real faults of disc, `acquire` and guard.

    python tests/faults/safety_table.py [RUNS [SEED [FAULT ...]]]

The rig is emulated by this process behind real ports, so that it outlasts the programs that are killed. A run begins
`acquire`, waits for light, injects one or two faults within two seconds of each other, and measures how long the light
stays on after the first one. Where the disc hangs and `acquire` lives, it gets two Ctrl-C and must end before the disc
answers. The disc hangs for real where this is root on Linux: the captures are on an ext4 image
that is frozen (fsfreeze). Elsewhere the runs with a hung disc are left out, and the table says so.

A fault after which the run goes on, as a guard that is killed and restarted, counts as survived while the run is
watched: what is asked for then is that the light was off until the next guard confirmed.
"""

import contextlib
import fcntl
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from simulated_rig import write_rig

from simulators.rig.rig import SimulatedRig
from simulators.rig.served_rig import serve

LIMIT_S = 2.0
#: Of linux/fs.h: as `fsfreeze -f`.
FIFREEZE = 0xC0045877
#: Two faults closer than this leave no program that could act: docs/safety.md, "What software cannot do".
TOO_CLOSE_S = 1.0
SINGLE = ["disc hung", "acquire killed", "acquire frozen", "acquire starved", "guard killed", "guard frozen",
          "guard starved", "guard missing"]  # fmt: skip


class Discs:
    """Folders for captures on a disc that can be frozen, where that is possible."""

    def __init__(self, work: Path) -> None:
        self._mount = work / "disc"
        self._mount.mkdir()
        self.can_hang = os.geteuid() == 0 and self._mounted(work / "disc.img")

    def _mounted(self, image: Path) -> bool:
        with image.open("wb") as file:
            file.truncate(256 << 20)
        try:
            subprocess.run(["mkfs.ext4", "-q", image], check=True, capture_output=True)
            subprocess.run(["mount", "-o", "loop", image, self._mount], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            return False
        return True

    def folder(self, name: str) -> Path:
        return self._mount / name

    def hang(self) -> None:
        # Not the command of that name: on a busy machine it would begin late.
        folder = os.open(self._mount, os.O_RDONLY)
        try:
            fcntl.ioctl(folder, FIFREEZE, 0)
        finally:
            os.close(folder)

    def thaw(self) -> None:
        subprocess.run(["fsfreeze", "-u", self._mount], check=False, capture_output=True)

    def close(self) -> None:
        if self.can_hang:
            self.thaw()
            subprocess.run(["umount", "-l", self._mount], check=False)


class Run:
    """One `acquire` with its guard."""

    def __init__(self, rig: Path, out: Path, work: Path, *, guard: bool = True) -> None:
        self.out, self._starved = out, threading.Event()
        self.errors = work / "errors.txt"
        environment = os.environ | {"XDG_RUNTIME_DIR": str(work)}
        if not guard:
            # A guard that cannot begin: the module that it runs as fails at once.
            broken = work / "broken"
            broken.mkdir(exist_ok=True)
            (broken / "sitecustomize.py").write_text(
                "import sys\nif 'acquisition.rig.guard' in sys.orig_argv:\n    raise SystemExit(3)\n"
            )
            environment["PYTHONPATH"] = str(broken)
        command = ["-m", "acquisition.commands.application", "--omega", "35", "--rig", str(rig), "--out", str(out)]
        with self.errors.open("w") as errors:
            self.child = subprocess.Popen(
                [sys.executable, *command], stdout=subprocess.DEVNULL, stderr=errors, env=environment
            )

    def guards(self) -> list[int]:
        pids = []
        for status in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                parent = int(status.read_text().rpartition(")")[2].split()[1])
                if parent == self.child.pid and b"acquisition.rig.guard" in (status.parent / "cmdline").read_bytes():
                    pids.append(int(status.parent.name))
        return pids

    def inject(self, fault: str, discs: Discs, guards: list[int]) -> None:
        who, _, action = fault.partition(" ")
        pids = [self.child.pid] if who == "acquire" else (guards or self.guards())
        if who == "disc":
            discs.hang()
        for pid in pids if who != "disc" else []:
            with contextlib.suppress(ProcessLookupError):
                if action == "starved":
                    threading.Thread(target=self._starve, args=(pid,), daemon=True).start()
                elif action != "missing":
                    os.kill(pid, signal.SIGKILL if action == "killed" else signal.SIGSTOP)

    def _starve(self, pid: int) -> None:
        """A hundredth of the time for each second: a machine that has next to none for it."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            while not self._starved.wait(0.99):
                os.kill(pid, signal.SIGCONT)
                time.sleep(0.01)
                os.kill(pid, signal.SIGSTOP)
            os.kill(pid, signal.SIGCONT)

    def interrupted(self) -> float:
        """How long `acquire` takes to end after two Ctrl-C, while the disc hangs; 99 where it does not."""
        begin_s = time.monotonic()
        for _ in range(2):
            self.child.send_signal(signal.SIGINT)
            time.sleep(0.2)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.child.wait(30)
            return time.monotonic() - begin_s
        return 99.0

    def end(self, guards: list[int], work: Path) -> str:
        """Let everything go and end it; returns all that was reported."""
        self._starved.set()
        for pid in (self.child.pid, *guards):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        late = self.guards()
        time.sleep(0.3)
        self.child.kill()
        self.child.wait()
        text = self.errors.read_text() + (work / "told.txt").read_text() if (work / "told.txt").exists() else ""
        text += self.errors.read_text()
        end_s = time.monotonic() + 60
        while any(Path(f"/proc/{pid}").exists() for pid in (*guards, *late)) and time.monotonic() < end_s:
            for alarm in (work / "umov").glob("alarm-*.json"):
                text += alarm.read_text()
                alarm.unlink(missing_ok=True)
            time.sleep(0.05)
        if (self.out / "guard.jsonl").exists():
            text += (self.out / "guard.jsonl").read_text()
        return text


@contextlib.contextmanager
def served(work: Path, *, cutoff: bool) -> Iterator[tuple[SimulatedRig, Path]]:
    hook = work / "hook.sh"
    hook.write_text(f'#!/bin/sh\necho "$1" >> {work / "told.txt"}\n')
    hook.chmod(0o755)
    rig = write_rig(
        work / "rig.yaml", {"rows": 64, "columns": 80, "clock_speed": 1, "camera_wait_s": 600}, alert=[str(hook)]
    )
    with serve(rig, work / "served.yaml", "red_sphere") as simulation:
        if cutoff:
            from simulators.clock import FastClock, patient_clock
            from simulators.controllers.i7000 import I7060Emulator
            from simulators.serial.pty_port import PtyPort

            simulation.emulators["relay"] = relay = I7060Emulator(FastClock(1.0, base=patient_clock()))
            with PtyPort(relay) as port, (work / "served.yaml").open("a") as file:
                file.write(f"cutoff: {{kind: i7000, port: {port.path}, watchdog_s: 1.0}}\n")
                file.flush()
                yield simulation, work / "served.yaml"
        else:
            yield simulation, work / "served.yaml"


def once(number: int, faults: list[str], gap_s: float, discs: Discs, *, cutoff: bool) -> dict[str, object] | None:
    """One run; what became of the light, and whether it was reported. None where there was no light to shut."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name, contextlib.ExitStack() as stack:
        work = Path(name)
        simulation, rig = stack.enter_context(served(work, cutoff=cutoff))
        out = discs.folder(f"run{number}") if discs.can_hang else work / "out"
        run = Run(rig, out, work, guard="guard missing" not in faults)
        if "guard missing" in faults:
            # Nothing may be lit at all, until the loss is reported and for a while after it.
            end_s, lit, reported = time.monotonic() + 90, False, False
            while time.monotonic() < end_s and run.child.poll() is None and not lit:
                lit = simulation.light() > 0
                if not reported and (reported := "guard" in run.errors.read_text()):
                    end_s = time.monotonic() + 10
                time.sleep(0.01)
            text = run.end([], work)
            shutil.rmtree(out, ignore_errors=True)
            return {"dark_s": 99.0 if lit else 0.0, "reported": "guard" in text}
        while not simulation.light():
            if run.child.poll() is not None:
                print(f"ended before there was light: {run.errors.read_text()[-300:]}", file=sys.stderr)
                shutil.rmtree(out, ignore_errors=True)
                return None
            time.sleep(0.005)
        time.sleep(random.uniform(0, 0.5))
        while not simulation.light() and run.child.poll() is None:
            time.sleep(0.005)
        guards = run.guards()
        begin_s = time.monotonic()
        run.inject(faults[0], discs, guards)
        waiting = list(faults[1:])
        dark_s = None
        while dark_s is None and time.monotonic() < begin_s + 8:
            if waiting and time.monotonic() - begin_s >= gap_s:
                run.inject(waiting.pop(0), discs, run.guards() or guards)
            if not simulation.light():
                dark_s = time.monotonic() - begin_s
            time.sleep(0.005)
        # A second fault may have to come still; what counts after it is that no light stays on.
        if waiting:
            time.sleep(max(0.0, begin_s + gap_s - time.monotonic()))
            again_s = time.monotonic()
            run.inject(waiting.pop(0), discs, run.guards() or guards)
            while simulation.light() and time.monotonic() < again_s + 8:
                time.sleep(0.005)
            dark_s = max(dark_s or 0.0, time.monotonic() - again_s)
        ended_s = (
            run.interrupted() if "disc hung" in faults and not any("acquire" in fault for fault in faults) else 0.0
        )
        discs.thaw()
        text = run.end(list({*guards, *run.guards()}), work)
        # The disc is small.
        shutil.rmtree(out, ignore_errors=True)
    words = ("guard", "acquire was", "acquire died", "disc", "LIGHT")
    reported = any(word in text for word in words)
    return {"dark_s": 8.0 if dark_s is None else dark_s, "reported": reported, "ended_s": ended_s}


def main() -> None:
    """Print the table."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    chance = random.Random(seed)
    random.seed(seed)
    table: dict[tuple[str, str], list[dict[str, object]]] = defaultdict(list)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        discs = Discs(Path(name))
        try:
            choices = sys.argv[3:] or (SINGLE if discs.can_hang else SINGLE[1:])
            for number in range(runs):
                faults = chance.sample(choices, min(len(choices), chance.choice([1, 2])))
                if "guard missing" in faults:
                    faults = ["guard missing"]
                gap_s, cutoff = chance.uniform(0, 3), chance.random() < 0.3
                victims = {fault.split()[0] for fault in faults}
                doomed = victims == {"acquire", "guard"} and gap_s < TOO_CLOSE_S and not cutoff
                for _ in range(3):
                    if (outcome := once(number, faults, gap_s, discs, cutoff=cutoff)) is not None:
                        break
                else:
                    raise SystemExit("three runs in a row ended before there was light")
                kind = "25 disc" if "disc" in victims else "26 guard" if "guard" in victims else "17 acquire"
                hardware = "relay" if cutoff else "both at once" if doomed else "none"
                outcome |= {"faults": faults, "gap_s": round(gap_s, 2), "hardware": hardware, "number": number}
                table[kind, " + ".join(sorted(faults)) + f", {hardware}"].append(outcome)
                print(json.dumps(outcome), flush=True)
        finally:
            discs.close()
    print(f"\n{'promise':11s} {'fault':52s} {'runs':>4s} {'dark':>4s} {'worst s':>7s} {'reported':>8s} {'ended s':>8s}")
    for (promise, fault), found_runs in sorted(table.items()):
        dark = [float(str(outcome["dark_s"])) for outcome in found_runs]
        print(
            f"{promise:11s} {fault:52s} {len(dark):4d} {sum(d <= LIMIT_S for d in dark):4d} {max(dark):7.2f} "
            f"{sum(bool(outcome['reported']) for outcome in found_runs):8d} "
            f"{max(float(str(outcome.get('ended_s', 0))) for outcome in found_runs):8.2f}"
        )


if __name__ == "__main__":
    main()
