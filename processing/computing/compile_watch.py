"""Who wants to know that loops are being compiled. Apart from `computing.compiling`, which takes long to import."""

from collections.abc import Callable

#: Each is called, without arguments, whenever a compilation begins.
watchers: list[Callable[[], None]] = []
