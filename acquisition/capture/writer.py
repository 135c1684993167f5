"""Writes a capture state by state so that neither a crash nor a power cut takes a state that was marked done.

All space is taken before the first motion. Each state is written, synced, marked done and synced again, by the disc
process, while the next state is under way. A finished file loses its `.partial` and is on the disc by then.
"""

import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.capture.partial_file import create_partial, finish
from acquisition.capture.state_file import StateFile
from acquisition.disc import disc, on_disc
from acquisition.errors import AcquisitionError
from drivers.clock import REAL, Clock
from drivers.motion import Position
from processing.instrument.states import StateTable
from processing.storage.captures.schema import CaptureHeader, Status

#: How long the disc may take for one state before nothing is measured any more, and before the run is ended.
PATIENCE_S = 1.5
DEAD_S = 30.0
#: How long any call may take before the light is shut; one that changes no byte is tried every LOOK_S.
DARK_S = 0.8
LOOK_S = 0.1


@dataclass(frozen=True)
class StateRecord:
    """One state taken: its frame, the positions read back, and the columns of the state table."""

    state: int
    pixels: NDArray[Any]
    positions: Mapping[str, Position]
    columns: Mapping[str, float] = field(default_factory=dict)


class CaptureWriter:
    """An open `.partial` file, in which the disc process writes.

    `put` hands over a state once the one before is on the disc, and returns at once: a power cut takes one state at
    most of those handed over. Whatever ends the writing is raised by the next `put` or by `seal`, and told to
    `on_failure` at once.

    Attributes
    ----------
    on_failure : called from another thread with what `put` would raise.
    on_blocked : called from another thread, once each time the disc has taken nothing for DARK_S.
    segment : number of the segment that the states written now belong to.

    Parameters
    ----------
    path : of the partial file.
    clock : measures how long the disc takes.
    """

    def __init__(self, path: Path, clock: Clock = REAL) -> None:
        # Its name changes when it is sealed; there it keeps the one that it was opened with.
        self.path = self._place = path
        self._clock = clock
        self._disc = disc()
        self.segment = 0
        self.on_failure: Callable[[AcquisitionError], None] | None = None
        self.on_blocked: Callable[[], None] | None = None
        self._state: Future[None] | None = None
        self._since_s, self._thread_id = 0.0, 0
        self._ended = threading.Event()
        self._disc.call(f"open {path}", _open, path)
        self._watching = threading.Thread(target=self._watch, name="capture writer, watch", daemon=True)
        self._watching.start()

    @classmethod
    def create(
        cls,
        path: Path,
        header: CaptureHeader,
        table: StateTable,
        frame_shape: tuple[int, int],
        *,
        start_time: str,
        begin: Mapping[str, Any] | None = None,
        clock: Clock = REAL,
    ) -> "CaptureWriter":
        """Create `path` + ".partial" with everything allocated.

        Parameters
        ----------
        begin : first line of the journal of segments; the file tells what it belongs to from the moment it is there.

        Raises
        ------
        AcquisitionError
            The file exists, the folder cannot be written, or the disc has not enough room.
        """
        return cls(
            on_disc(
                f"create {path}", create_partial, path, header, table, frame_shape, start_time=start_time, begin=begin
            ),
            clock,
        )

    def put(self, record: StateRecord) -> None:
        """Hand over a state, when the one before is on the disc. Raises AcquisitionError after DEAD_S."""
        self.settle()
        pixels = record.pixels if record.pixels.ndim == 3 else record.pixels[np.newaxis]
        positions = {axis: (position.deg, position.counts) for axis, position in record.positions.items()}
        columns = {**record.columns, "segment": self.segment}
        self._since_s = self._clock.now_s()
        self._state = self._disc.submit(_write_state, self._place, record.state, positions, columns, frame=pixels)
        self._thread_id = threading.get_ident()
        self._state.add_done_callback(self._on_written)
        if self._state.done():
            self.settle()

    def _on_written(self, state: Future[None]) -> None:
        error = state.exception()
        # `put` itself reports a state that has failed already: a future swallows an error raised here.
        if error is not None and self.on_failure is not None and threading.get_ident() != self._thread_id:
            self.on_failure(self._failure(error))

    def set_exposure(self, exposure_s: NDArray[np.float64]) -> None:
        """Write the exposure of every state; NaN while it is not known."""
        self._call("write_column", "exposure_s", exposure_s)

    def forget(self) -> None:
        """Mark every state as not done."""
        self._call("forget")

    def segment_records(self) -> list[dict[str, Any]]:
        """The lines of the journal of segments."""
        records: list[dict[str, Any]] = self._call("segment_records")
        return records

    def add_segment_record(self, record: Mapping[str, Any], part: float = 1.0) -> None:
        """Add a line to the journal of segments. Raises AcquisitionError if it is full."""
        self._call("add_segment_record", record, part)

    def _call(self, method: str, *arguments: Any) -> Any:
        """Have the open file do something, once the states handed over are on the disc."""
        self.settle()
        try:
            return self._disc.call(f"write {self.path}", _call_on_file, self._place, method, *arguments)
        except OSError as error:
            raise self._failure(error) from error

    def seal(self, status: Status, closing: Mapping[str, Any], *, keep_partial: bool = False) -> Path:
        """Write what waits, the closing record and the status; give the file its final name.

        Parameters
        ----------
        keep_partial : leave the name as it is, for a run that can be resumed.

        Returns
        -------
        Path of the file.

        Raises
        ------
        AcquisitionError
            A state could not be written.
        """
        try:
            self._call("require_at", self.path)
            self._call("write_closing", closing)
            self._call("write_status", status)
            if not keep_partial:
                self.path = self._disc.call(f"seal {self.path}", finish, self.path)
        except OSError as error:
            raise self._failure(error) from error
        finally:
            self.abandon()
        return self.path

    def abandon(self) -> None:
        """Write what waits, if the disc takes it, and let go of the file; never raises."""
        if not self._ended.is_set():
            self._ended.set()
            wait([self._disc.submit(_close, self._place)], PATIENCE_S)
            self._watching.join(PATIENCE_S)

    def is_settled(self) -> bool:
        """Wait until every state handed over is on the disc, but for PATIENCE_S at most. Raises AcquisitionError."""
        return self._wait_for_state(PATIENCE_S)

    def settle(self, *, in_haste: bool = False) -> None:
        """Wait until every state handed over is on the disc. Raises AcquisitionError, after DEAD_S at most.

        Parameters
        ----------
        in_haste : for a run that has failed already, wait for PATIENCE_S only, here and with all that follows.
        """
        if in_haste:
            self._disc.hurry()
        patience_s = PATIENCE_S if in_haste else DEAD_S
        if not self._wait_for_state(patience_s):
            raise self._blocked_error(patience_s)

    def _wait_for_state(self, patience_s: float) -> bool:
        if self._state is None:
            return True
        while not wait([self._state], LOOK_S).done:
            if self._clock.now_s() - self._since_s > patience_s:
                return False
        error = self._state.exception()
        if error is not None:
            raise self._failure(error) from error
        return True

    def _watch(self) -> None:
        """Ask for a sign of the disc again and again: one that hangs is noticed in a long exposure too."""
        probe, answered_s, is_blocked = self._disc.submit(os.utime, self.path), self._clock.now_s(), False
        while not self._ended.wait(LOOK_S):
            now_s = self._clock.now_s()
            if probe.done():
                probe, answered_s = self._disc.submit(os.utime, self.path), now_s
            if is_blocked != (is_blocked := now_s - answered_s > DARK_S) and is_blocked and self.on_blocked:
                self.on_blocked()
            if self._state is not None and not self._state.done() and now_s - self._since_s > DEAD_S:
                if self.on_failure is not None:
                    self.on_failure(self._blocked_error(DEAD_S))
                return

    def _blocked_error(self, waited_s: float) -> AcquisitionError:
        return AcquisitionError(
            f"{self.path}: the disc has not taken a state for {waited_s:g} s. States done before it are "
            "intact; continue with --resume when the disc works again."
        )

    def _failure(self, error: BaseException) -> AcquisitionError:
        reason = str(error) or type(error).__name__
        return AcquisitionError(
            f"{self.path} could not be written ({reason}). States done before it are intact; "
            "continue with --resume when the disc works again."
        )


# --- what the disc process does --------------------------------------------------------------------------------------

#: Open files there, by their partial names.
_files: dict[Path, StateFile] = {}


def _open(path: Path) -> None:
    _files[path] = StateFile(path)


def _close(path: Path) -> None:
    if (file := _files.pop(path, None)) is not None:
        file.close()


def _call_on_file(path: Path, method: str, *arguments: Any) -> Any:
    return getattr(_files[path], method)(*arguments)


def _write_state(
    path: Path,
    state: int,
    positions: Mapping[str, tuple[float, float]],
    columns: Mapping[str, Any],
    *,
    frame: NDArray[Any],
) -> None:
    file = _files[path]
    file.require_at(path)
    file.write_state(state, frame, positions, columns)
