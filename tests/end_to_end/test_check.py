"""`process check`: whether an instrument is as it was when a reference was taken."""

import csv
import json
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
def test_what_changed_since_is_named_and_kept(air, process):
    reference = air("reference", 1.0, 1)
    for number, turned in enumerate((1.0, 1.5), 2):
        today = air(f"day_{number}", turned, number, flux=4.9e5)
        code, out, err = process("check", today, "--reference", reference)
        if number == 2:
            # One degree is ten times what a check sees; the reference has it as well.
            assert code == 0, err
            assert "unchanged since reference.h5" in out
            assert float(out.split("light: ")[1].split()[0]) == pytest.approx(-2, abs=0.1)
            assert "0 of 240 comparisons beyond noise" in out
    assert code == 1, err
    assert "changed since reference.h5" in out
    cause = out[out.index("cause, with the instrument as it was for reference.h5") :]
    # Half a degree is new; the degree of the reference is none.
    assert "psg_azimuth of psg_retarder" in cause
    azimuth = float(cause.split(": azimuth ")[1].split()[0])
    assert azimuth == pytest.approx(0.5, abs=0.02)
    with reference.with_suffix(".checks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["capture"], row["verdict"]) for row in rows] == [
        ("day_2.h5", "unchanged"),
        ("day_3.h5", "changed"),
    ]
    # M of a retarder turned by 0.5 degrees: about 2 sin(4 x 0.25 degrees).
    assert abs(float(rows[1]["m12"])) > 0.01
    assert abs(float(rows[0]["m12"])) < 5 * float(rows[0]["m12_error"])
    assert reference.with_suffix(".checks.png").stat().st_size > 10_000


@pytest.mark.long
def test_a_folder_is_checked_in_one_command(air, process, tmp_path):
    reference = air("reference", 0.0, 1)
    for number, turned in enumerate((0.0, 0.5), 1):
        air(f"day_{number}", turned, 1 + number)
    air("glass", 0.0, 4, kind="unknown")
    code, out, err = process("check", tmp_path, "--reference", reference)
    assert code == 1, err
    lines = [line.split()[:2] for line in out.splitlines() if line.startswith(("changed", "unchanged"))]
    assert lines == [["unchanged", f"{tmp_path}/day_1.h5"], ["changed", f"{tmp_path}/day_2.h5"]]
    assert "2 inputs: 1 changed, 1 unchanged, 0 failed" in out
    assert "psg_azimuth of psg_retarder" in out[out.index(f"newest change: {tmp_path}/day_2.h5") :]
    assert reference.with_suffix(".checks.png").exists()
    # The products that the check made are no captures.
    assert process("check", tmp_path, tmp_path / "glass.h5", "--reference", reference)[0] == 2
    assert len(reference.with_suffix(".checks.csv").read_text().splitlines()) == 3


def test_another_sample_is_no_check(air, process):
    code, _, err = process("check", air("today", 0, 2, kind="unknown"), "--reference", air("reference", 0, 1))
    assert (code, "sample unknown, but" in err, "--reference" in err) == (2, True, True), err


@pytest.mark.parametrize("seed", range(2))
def test_noise_alone_is_no_change(air, process, seed):
    reference, today = air("reference", 0.0, 10 + seed), air("today", 0.0, 20 + seed)
    code, out, err = process("check", today, "--reference", reference, "--tolerance", 0)
    assert code == 0, out + err
