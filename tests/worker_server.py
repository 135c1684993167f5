"""Test processes that share their work: a server imports every test once, and each process is a fork of it.

`pytest-xdist` starts a process by a command and speaks to it over standard input and output. Our command hands both to
the server, and ends when the process does. A loop that several processes need is compiled by one.
"""

import gc
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from types import ModuleType


class WorkerServer:
    """A server for a run of pytest with these arguments."""

    def __init__(self, arguments: tuple[str, ...]) -> None:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind("")
            listener.listen()
            number = listener.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.worker_server", "serve", str(number), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=[number],
            )
            #: Starts a test process.
            self.command = f"{sys.executable} -IS {__file__} join {listener.getsockname().hex()}"

    def close(self) -> None:
        """Let no further process begin."""
        self._process.communicate()


def _serve(number: str, *arguments: str) -> None:
    import pytest

    listener = socket.socket(fileno=int(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with tempfile.TemporaryDirectory() as locks:
        _compile_once(locks)
        _fork(_compile_early)
        if pytest.main([*arguments, "--collect-only", "-qq", "-p", "no:cacheprovider"]):
            # What cannot be imported each process tries again, and reports.
            for name in [name for name in sys.modules if name.startswith("tests.")]:
                del sys.modules[name]
        gc.freeze()
        while listener in select.select([listener, 0], [], [])[0]:
            connection, _ = listener.accept()
            _fork(_work, connection)
            connection.close()


def _fork(task: Callable[..., None], *arguments: object) -> None:
    if os.fork() == 0:
        try:
            task(*arguments)
        finally:
            os._exit(0)


def _compile_once(locks: str) -> None:
    """Let a process that needs a loop wait for the one that compiles it: then numba's cache has it."""
    from filelock import FileLock
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compile_loop = Dispatcher.compile

    def compile_alone(loop: Dispatcher, signature: object) -> object:
        name = f"{locks}/{loop.py_func.__module__}.{loop.py_func.__qualname__}"
        # numba's lock first: else each of two threads would hold one of the two.
        with global_compiler_lock, FileLock(name, is_singleton=True):
            return compile_loop(loop, signature)

    Dispatcher.compile = compile_alone


def _compile_early() -> None:
    """Compile what takes longest while the tests are imported: another processor has nothing to do."""
    import numpy as np

    from processing.polarization.cloude import xi0_and_dominant
    from processing.polarization.decompositions.lu_chipman import lu_chipman

    xi0_and_dominant(np.eye(4))
    lu_chipman(np.eye(4))


def _work(connection: socket.socket) -> None:
    """Do what `python -c` does with the words that execnet sends; whoever waits sees that the connection ends."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _, streams, _, _ = socket.recv_fds(connection, 1, 2)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    main = sys.modules["__main__"] = ModuleType("__main__")
    exec(eval(sys.stdin.readline()), main.__dict__)


def _join(address: str, *_: str) -> None:
    """Let a fork of the server use our streams; execnet adds options of Python."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(bytes.fromhex(address))
        socket.send_fds(connection, [b"."], [0, 1])
        connection.recv(1)


if __name__ == "__main__":
    {"serve": _serve, "join": _join}[sys.argv[1]](*sys.argv[2:])
