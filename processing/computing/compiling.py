"""numba's `njit` for all compiled loops, and word of the first compilation to whoever waits at a terminal.

Compiled code is kept beside the source; only a fresh installation, or a change of the processor, compiles again.
"""

from typing import Any

from numba import njit
from numba.core import event

from processing.computing import compile_watch

__all__ = ["njit"]


class _Teller(event.Listener):
    """numba fires this event when its cache has no code, before the work begins."""

    def on_start(self, _event: Any) -> None:
        for tell in tuple(compile_watch.watchers):
            tell()

    def on_end(self, _event: Any) -> None:
        pass


event.register("numba:compile", _Teller())  # type: ignore[no-untyped-call]
