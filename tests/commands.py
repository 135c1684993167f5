"""Entry points of the command line, run in the process of the tests."""

from collections.abc import Callable
from typing import Any

import pytest


def exit_code(main: Callable[[list[str]], Any], *arguments: object) -> Any:
    """Exit code of an entry point with these arguments; 0 where it ends without one."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code or 0
