"""`process check`: whether an instrument is as it was when a reference was taken."""

import csv
import json
import sys
from pathlib import Path

import h5py
import pytest

from processing.instrument.model import InstrumentModel
from simulators.bench.bench import SimulatedBench
from simulators.bench.scene import Scene
from simulators.bench.virtual_capture import write_virtual_capture


@pytest.fixture
def air(tmp_path, configs):
    """Writes a capture of air, its generator's retarder turned by some degrees."""
    instrument = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    scene = Scene.load(configs / "scenes/air.yaml")
    azimuth = instrument.value_of("psg_retarder.azimuth_deg")

    def take(name: str, turned_deg: float, seed: int, flux: float = 5e5, kind: str = "air") -> Path:
        turned = {nm: value + turned_deg for nm, value in azimuth.items()}
        true = instrument.with_values({"psg_retarder": {"azimuth_deg": turned}})
        bench = SimulatedBench(scene, true, 662, rows=32, columns=32, seed=seed, flux_e_per_s=flux)
        path = tmp_path / f"{name}.h5"
        write_virtual_capture(path, bench, instrument, 180, darks=2)
        with h5py.File(path, "r+") as h5:
            header = json.loads(h5["entry"].attrs["header_json"]) | {"sample": {"kind": kind, "name": kind}}
            h5["entry"].attrs["header_json"] = json.dumps(header)
        return path

    return take


@pytest.mark.long
@pytest.mark.usefixtures("figures")
def test_what_changed_since_is_named_and_kept(air, process, tmp_path, monkeypatch):
    reference = air("reference", 1.0, 1)
    unchanged, _ = air("day_2", 1.0, 2, flux=4.9e5), air("glass", 1.0, 4, kind="unknown")
    # One degree is ten times what a check sees; the reference has it as well.
    out = process.made("check", unchanged, "--reference", reference)
    assert "unchanged since reference.h5" in out
    assert float(out.split("light: ")[1].split()[0]) == pytest.approx(-2, abs=0.1)
    assert "0 of 240 comparisons beyond noise" in out
    table = reference.with_suffix(".checks.csv")
    table.unlink()
    changed = air("day_3", 1.5, 3, flux=4.9e5)
    code, out, err = process("check", tmp_path, "--reference", reference)
    assert code == 1, err
    lines = [line.split()[:2] for line in out.splitlines() if line.startswith(("changed", "unchanged"))]
    assert lines == [["unchanged", str(unchanged)], ["changed", str(changed)]]
    assert "2 inputs: 1 changed, 1 unchanged, 0 failed" in out
    cause = out[out.index(f"newest change: {changed}\ncause, with the instrument as it was for reference.h5") :]
    # Half a degree is new; the degree of the reference is none.
    assert "psg_azimuth of psg_retarder" in cause
    azimuth = float(cause.split(": azimuth ")[1].split()[0])
    assert azimuth == pytest.approx(0.5, abs=0.02)
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["capture"], row["verdict"]) for row in rows] == [("day_2.h5", "unchanged"), ("day_3.h5", "changed")]
    # M of a retarder turned by 0.5 degrees: about 2 sin(4 x 0.25 degrees).
    assert abs(float(rows[1]["m12"])) > 0.01
    assert abs(float(rows[0]["m12"])) < 5 * float(rows[0]["m12_error"])
    assert reference.with_suffix(".checks.png").stat().st_size > 10_000
    # The products that the check made are no captures.
    assert process("check", tmp_path, tmp_path / "glass.h5", "--reference", reference)[0] == 2
    assert len(table.read_text().splitlines()) == 3
    monkeypatch.setattr("processing.diagnosis.instrument.diagnose.diagnose_captures", lambda *_: sys.exit(3))
    code, out, _ = process("check", changed, "--reference", reference)
    assert (code, "\nchanged since reference.h5\n" in out) == (3, True)


def test_another_sample_is_no_check(air, process):
    code, _, err = process("check", air("today", 0, 2, kind="unknown"), "--reference", air("reference", 0, 1))
    assert (code, "sample unknown, but" in err, "--reference" in err) == (2, True, True), err


def test_noise_alone_is_no_change(air, process):
    reference, today = air("reference", 0.0, 10), air("today", 0.0, 20)
    code, out, err = process("check", today, "--reference", reference, "--tolerance", 0)
    assert code == 0, out + err
