"""What `diagnose` writes, and when."""

import pytest
from bench_capture import bench_capture

from processing.commands import diagnose
from processing.commands.loaded_late import diagnose_summary
from processing.instrument.model import InstrumentModel
from simulators.blind.undeclared_captures import TrueBench


def test_files_are_written_although_nobody_reads_the_words(configs, tmp_path, monkeypatch):
    """`diagnose --write FILE | head` wrote no file."""
    capture = bench_capture(
        tmp_path, configs / "instruments/rgb950.yaml", TrueBench(rows=16, columns=16), True, 24, seed=3
    )

    def closed(*_, **__):
        raise BrokenPipeError

    monkeypatch.setattr(diagnose_summary, "show", closed)
    with pytest.raises((SystemExit, BrokenPipeError)):
        diagnose.main([str(capture), "--write", str(tmp_path / "new.yaml")])
    assert InstrumentModel.load(tmp_path / "new.yaml").systematic
