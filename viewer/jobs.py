"""Jobs of the application: commands of the console, each in a process that outlives the page.

Every button runs a command that could be typed as well, and the page shows it. Output and exit code are kept in a
hidden folder beside the data, so that every tab sees them, and a later start of the application too.
"""

import contextlib
import json
import os
import secrets
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from acquisition.screen.run_file import start_ticks
from drivers.log_process import start_appending
from processing.doors import read_json
from processing.errors import ProcessError
from viewer.library import OWN, NotHere

#: Modules behind the commands of the console.
MODULES = {
    "acquire": "acquisition.commands.application",
    "process": "processing.commands.application",
    "diagnose": "processing.commands.diagnose",
}
#: Characters of the output that a page shows, from its end.
SHOWN = 20_000
#: Longest wait for the end of the output once a command has ended.
OUTPUT_S = 10.0


@dataclass(frozen=True)
class PageJob:
    """One command that was started.

    Attributes
    ----------
    name : of its folder.
    command : as it could be typed.
    about : names of the files it works on, by kind ("capture", "campaign", "diagnosis").
    """

    name: str
    title: str
    command: tuple[str, ...]
    about: dict[str, str]
    begun_s: float
    pid: int
    ticks: int | None

    @property
    def typed(self) -> str:
        """The command for a console."""
        return shlex.join([os.environ.get("UMOV_DOOR", "./lab"), *self.command])


class Jobs:
    """The commands started in one folder."""

    def __init__(self, root: Path) -> None:
        self._folder = root / OWN / "jobs"

    def start(self, title: str, command: Sequence[str], about: dict[str, str], cwd: Path) -> PageJob:
        """Start a command of the console.

        Parameters
        ----------
        command : first `acquire`, `process` or `diagnose`, then what follows it.
        """
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        folder = self._folder / name
        folder.mkdir(parents=True)
        environment = {k: v for k, v in os.environ.items() if k != "HDF5_USE_FILE_LOCKING"}
        # Plain text of any width, as into a file.
        environment |= {"PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "UMOV_DOOR": os.environ.get("UMOV_DOOR", "./lab")}
        # Through a pipe: a program that writes to a hanging disc can neither measure nor end.
        output = start_appending(folder / "output.txt")
        assert output.stdin is not None
        with output.stdin as pipe:
            process = subprocess.Popen(
                [sys.executable, "-m", MODULES[command[0]], *command[1:]],
                stdin=subprocess.DEVNULL,
                stdout=pipe,
                stderr=subprocess.STDOUT,
                cwd=cwd,
                env=environment,
                # Ctrl-C for the application is not meant for a measurement that it has started.
                start_new_session=True,
            )
        job = PageJob(name, title, tuple(command), about, time.time(), process.pid, start_ticks(process.pid))
        (folder / "job.json").write_text(json.dumps(asdict(job)), encoding="utf-8")
        threading.Thread(target=self._wait, args=(process, output, folder), name=f"job {name}", daemon=True).start()
        return job

    @staticmethod
    def _wait(process: subprocess.Popen[bytes], output: subprocess.Popen[bytes], folder: Path) -> None:
        code = process.wait()
        # A command that it has started may hold the pipe for longer.
        with contextlib.suppress(subprocess.TimeoutExpired):
            output.wait(OUTPUT_S)
        with contextlib.suppress(OSError):
            (folder / "code").write_text(str(code), encoding="utf-8")

    def job(self, name: str) -> PageJob:
        """A job by its name. Raises NotHere."""
        path = self._folder / name / "job.json"
        # os.path.isfile, unlike Path.is_file, takes a name of any length.
        if "/" in name or "\0" in name or not os.path.isfile(path):
            raise NotHere(f"{name}: nothing of that name was started here")
        facts = read_json(path)
        return PageJob(**{**facts, "command": tuple(facts["command"])})

    def all(self) -> list[PageJob]:
        """Every job, the newest first."""
        jobs = []
        for path in sorted(self._folder.glob("*/job.json"), reverse=True):
            # Just being written, or cut off by a full disc.
            with contextlib.suppress(ProcessError):
                jobs.append(self.job(path.parent.name))
        return jobs

    def running(self, job: PageJob) -> bool:
        """Whether its process is still there."""
        return job.ticks is not None and start_ticks(job.pid) == job.ticks

    def code(self, job: PageJob) -> int | None:
        """Its exit code; None while it runs, or where the application had ended before it did."""
        with contextlib.suppress(OSError, ValueError):
            return int((self._folder / job.name / "code").read_text(encoding="utf-8"))
        return None

    def status(self, job: PageJob) -> str:
        """running, done, stopped, failed, or ended, which means that the exit code is unknown."""
        if self.running(job):
            return "running"
        code = self.code(job)
        if code is None:
            return "ended"
        return {0: "done", 130: "stopped"}.get(code, "failed")

    def output(self, job: PageJob) -> str:
        """The end of its output; of a progress bar the last state."""
        try:
            text = (self._folder / job.name / "output.txt").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""
        return "\n".join(line.rsplit("\r", 1)[-1] for line in text[-SHOWN:].split("\n"))

    def stop(self, job: PageJob) -> None:
        """Send it what Ctrl-C sends. Raises ProcessError if it has ended."""
        if not self.running(job):
            raise ProcessError(f"{job.title}: it has ended already")
        os.kill(job.pid, signal.SIGINT)
