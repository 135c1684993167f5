"""Compiling takes seconds once; who waits is told."""

import pytest

from processing.commands.progress_bar import progress_bar
from processing.computing import compile_watch
from processing.computing.compiling import njit


def test_a_compilation_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    @njit
    def twice(x):
        return 2 * x

    @njit
    def thrice(x):
        return 3 * x

    with progress_bar("work", "rows"):
        assert twice(2) + thrice(2) == 10
    assert capsys.readouterr().err.count("compiling loops") == 1
    assert not compile_watch.watchers
    with progress_bar("work", "rows"):
        assert twice(2) + thrice(2) == 10
    assert "compiling" not in capsys.readouterr().err
