"""Entry points of the command line, run in the process of the tests."""

from collections.abc import Callable
from typing import Any

import pytest


def exit_code(main: Callable[[list[str]], Any], *arguments: object) -> Any:
    """Exit code of an entry point with these arguments; 0 where it ends without one."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code or 0


class Program:
    """Runs an entry point; a call gives exit code, standard output and standard error."""

    def __init__(self, run: Callable[..., tuple[int, str, str]]) -> None:
        self._run = run

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        return self._run(*arguments)

    def made(self, *arguments: object) -> str:
        """Standard output of a command that succeeds."""
        code, out, err = self._run(*arguments)
        assert code == 0, out + err
        return out

    def refused(self, *arguments: object) -> str:
        """What a command says that refuses its input."""
        code, _, err = self._run(*arguments)
        assert code == 2, err
        return err
