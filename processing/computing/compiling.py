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
    """Decorator of a loop: it is compiled, or replaced by `plain`, which takes and fills the same arrays.

    Without `plain` it is called by other loops alone. `options` are those of `numba.njit`; the loop's `plain` stays in
    sight for tests.
    """

    def chosen(loop: Any) -> Any:
        if njit is None:
            return plain or loop
        made = njit(cache=True, nogil=True, **options)(loop)
        made.plain = plain
        return made

    return chosen


def in_parts(at_once: Callable[..., None]) -> Callable[..., None]:
    """Of `at_once(*arrays, part)`, the same of a range `(*arrays, start, stop)`, part after part."""

    def all_parts(*words: Any) -> None:
        *arrays, start, stop = words
        for first in range(start, stop, PART):
            at_once(*arrays, slice(first, min(first + PART, stop)))

    return all_parts
