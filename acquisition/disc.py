"""The disc process: a child of this program that opens, writes and syncs the files of the captures.

Linux lets no process end, and hear no Ctrl-C, while one of its threads waits for a disc in the kernel. Here the child
waits. The program that measures sends it one call at a time and can go on, shut the light and end without an answer.
"""

import contextlib
import ctypes
import gc
import mmap
import os
import queue
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback  # type: ignore[attr-defined]
from pathlib import Path
from typing import Any, NoReturn, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import AcquisitionError

P = ParamSpec("P")
T = TypeVar("T")

#: Longest wait for a disc that takes nothing; the same for a run that has failed already.
DISC_S, HASTE_S = 30.0, 1.5
#: How often a waiting thread can be interrupted, and how long an orderly end may take.
SLICE_S, END_S = 0.1, 2.0
#: Of prctl: the signal that a process gets when its parent has ended.
PR_SET_PDEATHSIG = 1


class SharedFrame:
    """Memory for one frame that both processes see, so that no pixel goes through the pipe."""

    def __init__(self) -> None:
        self.file = os.memfd_create("frame", os.MFD_CLOEXEC)
        self._memory: mmap.mmap | None = None

    def array(self, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
        """The memory as an array of this shape; it grows as needed."""
        values = int(np.prod(shape))
        size = max(1, values * np.dtype(dtype).itemsize)
        if self._memory is None or len(self._memory) < size:
            os.ftruncate(self.file, max(size, os.fstat(self.file).st_size))
            self._memory = mmap.mmap(self.file, size)
        return np.frombuffer(self._memory, dtype, values).reshape(shape)

    def close(self) -> None:
        """Release the memory once no array of it exists."""
        self._memory = None
        os.close(self.file)


class DiscProcess:
    """A forked child that carries out calls one after the other; a thread hands them over.

    It closes all descriptors that it inherits: no port is held by it. It ends with this process.

    Raises
    ------
    AcquisitionError
        No process can be started.
    """

    def __init__(self) -> None:
        self._frame = SharedFrame()
        self._line, theirs = Pipe()
        self._patience_s = DISC_S
        self._busy_since_s: float | None = None
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Any, NDArray[Any] | None] | None] = queue.SimpleQueue()
        self.owner, self.has_ended = os.getpid(), False
        # A thread that ends counts as the parent's end.
        dies_with = self.owner if threading.current_thread() is threading.main_thread() else 0
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        try:
            with warnings.catch_warnings():
                # Python 3.12 warns of any thread, those of the linear algebra too. The child takes no lock of theirs.
                warnings.simplefilter("ignore", DeprecationWarning)
                self.pid = os.fork()
            if self.pid == 0:
                _serve(theirs, self._frame, dies_with)
        except OSError as error:
            raise AcquisitionError(
                f"no process can be started that writes the captures ({error}). Nothing was moved. End other programs, "
                "then give the same command."
            ) from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self._thread = threading.Thread(target=self._dispatch, name="disc", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:
            self._line.close()
            raise

    def submit(self, function: Callable[..., T], *arguments: Any, frame: NDArray[Any] | None = None) -> Future[T]:
        """Have a function of a module called there; `frame`, if any, arrives as the argument of that name."""
        future: Future[T] = Future()
        if self.has_ended:
            future.set_exception(_ended_error())
        else:
            self._jobs.put((future, (function, arguments), frame))
        return future

    def call(self, task: str, function: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
        """Call a function in the disc process and return its value.

        Raises AcquisitionError: the disc has not answered for DISC_S; the call ends when it answers.
        """
        future = self.submit(partial(function, **options), *arguments)
        while not wait([future], SLICE_S).done:
            since_s = self._busy_since_s
            if since_s is not None and time.monotonic() - since_s > self._patience_s:
                raise AcquisitionError(
                    f"{task}: the disc has not answered for {time.monotonic() - since_s:.0f} s. The light is off. Go "
                    "on with the same command, or --resume, when the disc works again."
                )
        return future.result()

    def hurry(self) -> None:
        """Wait for HASTE_S only from now on: the run has failed, or the user ends it."""
        self._patience_s = HASTE_S

    def end(self) -> None:
        """End the process after its last call; does not wait for a disc that hangs."""
        self._jobs.put(None)
        self._thread.join(HASTE_S)
        end_s = time.monotonic() + END_S
        while not self._thread.is_alive() and time.monotonic() < end_s:
            with contextlib.suppress(ChildProcessError):
                if os.waitpid(self.pid, os.WNOHANG)[0] == 0:
                    time.sleep(0.005)
                    continue
            break

    def _dispatch(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, request, frame = job
            self._busy_since_s = time.monotonic()
            try:
                self._line.send((*request, self._share(frame), _folder()))
                is_well, answer = self._line.recv()
            except (EOFError, ConnectionError):
                self.has_ended = True
                future.set_exception(_ended_error())
                break
            except Exception as error:  # noqa: BLE001 - what cannot be sent fails, and the next call goes on
                is_well, answer = False, error
            self._busy_since_s = None
            if is_well:
                future.set_result(answer)
            else:
                failure: BaseException = answer
                future.set_exception(failure)
        self.has_ended = True
        with contextlib.suppress(queue.Empty):
            while True:
                if (job := self._jobs.get_nowait()) is not None:
                    job[0].set_exception(_ended_error())
        self._line.close()
        self._frame.close()

    def _share(self, frame: NDArray[Any] | None) -> tuple[tuple[int, ...], str] | None:
        if frame is None:
            return None
        np.copyto(self._frame.array(frame.shape, frame.dtype.str), frame)
        return frame.shape, frame.dtype.str


def _folder() -> str | None:
    """The working folder; None of one that is gone."""
    with contextlib.suppress(OSError):
        return os.getcwd()
    return None


def _ended_error() -> AcquisitionError:
    return AcquisitionError("the process that writes the captures has ended: out of memory, or somebody killed it")


_current: DiscProcess | None = None
_starting = threading.Lock()
_is_child = False
#: Calls that a replacement begins with, by what they hold.
_holding: dict[Path, tuple[int, Callable[[], None]]] = {}


def disc() -> DiscProcess:
    """The disc process of this program; it is started if there is none. Raises AcquisitionError, and as `hold`."""
    global _current
    with _starting:
        if _current is None or _current.has_ended or _current.owner != os.getpid():
            starting = DiscProcess()
            try:
                for folder, (owner, take) in _holding.items():
                    if owner == starting.owner:
                        starting.call(f"lock {folder}", take)
            except BaseException:
                starting.end()
                raise
            _current = starting
        return _current


def hold(folder: Path, take: Callable[[Path], None]) -> None:
    """Have the disc process lock a folder, and each replacement of it, until `let_go`. Raises what `take` raises."""
    on_disc(f"lock {folder}", take, folder)
    _holding[folder] = os.getpid(), partial(take, folder)


def let_go(folder: Path, release: Callable[[Path], None]) -> None:
    """Have the disc process unlock a folder. Raises AcquisitionError."""
    _holding.pop(folder, None)
    on_disc(f"let go of {folder}", release, folder)


@contextmanager
def disc_process() -> Iterator[None]:
    """A disc process for this block; begin it before devices are open and threads run. Raises as `disc`."""
    disc()
    try:
        yield
    finally:
        end_disc()


def end_disc() -> None:
    """Let the disc process of this program end, if there is one; the next call begins another."""
    global _current
    with _starting:
        ending, _current = _current, None
    if ending is not None and ending.owner == os.getpid():
        ending.end()


def on_disc(task: str, function: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
    """Call a function in the disc process; a disc that hangs never holds the caller. Raises as `DiscProcess.call`."""
    return function(*arguments, **options) if _is_child else disc().call(task, function, *arguments, **options)


# --- in the child ----------------------------------------------------------------------------------------------------


def _serve(line: Connection, frame: SharedFrame, dies_with: int) -> NoReturn:
    """Answer calls until the other end is closed, or that process has ended."""
    global _is_child
    _is_child = True
    try:
        _close_all_but(line.fileno(), frame.file)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGTSTP):
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])
        if dies_with:
            # Killed with its parent, as one process would be.
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        # Objects that exist already are never collected: their pages stay shared.
        gc.freeze()
        while dies_with in (0, os.getppid()):
            function, arguments, shared, folder = line.recv()
            try:
                # Relative names are those of the program, which may have changed its folder since.
                if folder is not None:
                    os.chdir(folder)
                answer = True, function(*arguments, **({} if shared is None else {"frame": frame.array(*shared)}))
            except BaseException as error:  # noqa: BLE001 - raised again by the caller
                answer = False, ExceptionWithTraceback(error, error.__traceback__)
            _send(line, answer)
    except (EOFError, OSError):
        os._exit(0)
    finally:
        os._exit(1)


def _send(line: Connection, answer: tuple[bool, Any]) -> None:
    try:
        line.send(answer)
    except (EOFError, OSError):
        raise
    except Exception as error:  # noqa: BLE001 - a value that cannot be sent is told as such
        line.send((False, AcquisitionError(f"the answer of the disc process cannot be sent: {error}")))


def _close_all_but(*descriptors: int) -> None:
    """Close inherited descriptors; the standard streams lead nowhere, so that no program waits for their end."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nothing, number)
    for number in map(int, os.listdir("/proc/self/fd")):
        if number > 2 and number not in descriptors:
            with contextlib.suppress(OSError):
                os.close(number)
