"""Captures that begin in the same second get names of their own."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from acquisition.capture.free_name import free_name
from acquisition.errors import AcquisitionError


@pytest.mark.parametrize("name", ["c.h5", "c.h5.partial", "c.h5.new"])
def test_a_name_that_is_taken_gets_a_number(tmp_path, name):
    (tmp_path / name).write_bytes(b"there")
    with free_name(tmp_path / "c.h5") as path:
        assert path == tmp_path / "c-2.h5"
        with free_name(tmp_path / "c.h5") as another:
            assert another == tmp_path / "c-3.h5"
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == b"there"


def test_all_that_begin_at_once_get_different_names(tmp_path):
    at_once, named = Barrier(8, timeout=60), Barrier(8, timeout=60)

    def begin(_):
        at_once.wait()
        with free_name(tmp_path / "not there yet/c.h5") as path:
            named.wait()
            return path.name

    with ThreadPoolExecutor(8) as pool:
        names = sorted(pool.map(begin, range(8)))
    assert names == sorted(["c.h5", *(f"c-{number}.h5" for number in range(2, 9))])


def test_a_folder_that_cannot_be_written_is_told_with_the_way_out(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(AcquisitionError, match="Choose another folder with --out"), free_name(tmp_path / "file/c.h5"):
        pass
