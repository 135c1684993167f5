"""The one door to numba: loops over pixels, compiled where it is installed, else numpy's on all pixels at once.

Compiled code is kept beside the source; only a fresh installation, or a change of the processor, compiles again, and
whoever waits at a terminal is told.
"""

from collections.abc import Callable
from typing import Any

from processing.computing import compile_watch

#: Pixels that numpy takes at a time, where a loop takes one.
PART = 4096

try:
    from numba import njit
    from numba.core import event
except ImportError:
    njit = None  # type: ignore[assignment]
else:

    class _Teller(event.Listener):
        """numba fires this event when its cache has no code, before the work begins."""

        def on_start(self, _event: Any) -> None:
            for tell in tuple(compile_watch.watchers):
                tell()

        def on_end(self, _event: Any) -> None:
            pass

    event.register("numba:compile", _Teller())  # type: ignore[no-untyped-call]


def compiled(plain: Callable[..., Any] | None = None, **options: Any) -> Callable[[Any], Any]:
    """Decorator that compiles a loop, or replaces it by `plain` where numba is not installed.

    `plain` takes and fills the same arrays. A loop that only other loops call needs none. `options` are those of
    `numba.njit`. A compiled loop has its `plain` as an attribute, so that a test can compare both.
    """

    def chosen(loop: Any) -> Any:
        if njit is None:
            return plain or loop
        fast = njit(cache=True, nogil=True, **options)(loop)
        fast.plain = plain
        return fast

    return chosen


def in_parts(at_once: Callable[..., None]) -> Callable[..., None]:
    """Turn `at_once(*arrays, part)` into a function of `(*arrays, start, stop)` that takes `PART` pixels at a time."""

    def all_parts(*arguments: Any) -> None:
        *arrays, start, stop = arguments
        for first in range(start, stop, PART):
            at_once(*arrays, slice(first, min(first + PART, stop)))

    return all_parts
