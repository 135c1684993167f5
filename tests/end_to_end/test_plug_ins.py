"""A package from outside: axis and camera in a rig file, effect in an instrument file, model in a material file."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

SAMPLE = Path(__file__).parents[1] / "sample_plugin"


@pytest.fixture
def run(tmp_path):
    """Runs Python beside the installed sample package; kinds are found when a process starts."""

    def done(code, *arguments):
        path = os.pathsep.join(filter(None, [str(SAMPLE), os.environ.get("PYTHONPATH", "")]))
        command = [sys.executable, "-c", code, *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": path}
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)

    return done


def test_axis_and_camera_take_a_capture(run, small_rig, tmp_path):
    yaml = YAML()
    path = small_rig()
    rig = yaml.load(path)
    for name in ("psg", "psa"):
        rig["axes"][name]["kind"] = "sample_stage"
    rig["camera"]["kind"] = "sample_camera"
    with path.open("w") as file:
        yaml.dump(rig, file)
    code = "from acquisition.commands.application import main; import sys; main(sys.argv[1:])"
    done = run(code, "--omega", 35, "--rig", path, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "complete" in done.stdout


def test_effect_acts_in_an_instrument_file_and_is_searched(run, configs):
    code = """
import sys
import numpy as np
from processing.diagnosis.search.candidate import pool
from processing.instrument.applied_effects import changes_at
from processing.instrument.changes import Conditions
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.instrument.states import rotating_retarders
model = InstrumentModel.load(sys.argv[1]).at(662)
angles = rotating_retarders(1.0).angles_deg
conditions = Conditions.of(angles)
print(any(c.kind == "sample_hum" for c in pool(model, [conditions])))
hum = AppliedEffect(kind="sample_hum", parameters={"amplitude": EffectParameter(value=0.1, unit="1")})
with_hum = model.model_copy(update={"effects": (hum,)})
ratio = with_hum.rows(angles, changes_at(with_hum, angles))[:, 0, 0] / model.rows(angles)[:, 0, 0]
print(np.allclose(ratio, 1 + 0.1 * np.sin(np.pi / 4 * np.arange(40))))
"""
    done = run(code, configs / "instruments/rgb950.yaml")
    assert done.stdout.split() == ["True", "True"], done.stderr


def test_reflectance_model_of_a_material_file(run, tmp_path):
    (tmp_path / "material.yaml").write_text("kind: sample_mirror\nname: silver\n")
    done = run("from processing import load_reflectance; print(load_reflectance('material.yaml').name)")
    assert done.stdout.strip() == "silver", done.stderr


def test_a_plug_in_cannot_replace_a_kind(run, tmp_path):
    folder = tmp_path / "other-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[umov.axes]\nzaber = umov_sample.stage\n")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from drivers.registry import device_kinds; device_kinds('axes')"
    )
    done = run(code, tmp_path)
    assert "offers the kind 'zaber' of axes, which exists already" in done.stderr
