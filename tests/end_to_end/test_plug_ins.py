"""A package from outside: it passes the conformance kit, and rig, instrument and material files take what it brings."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from processing.storage.captures.capture import Capture

SAMPLE = Path(__file__).parents[1] / "sample_plugin"


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    """The sample package, installed by pip into a folder of its own."""
    source, target = (tmp_path_factory.mktemp(name) for name in ("source", "site"))
    # From a copy: a build leaves folders behind.
    for path in (SAMPLE / "pyproject.toml", *(SAMPLE / "umov_sample").glob("*.py")):
        copy = source / path.relative_to(SAMPLE)
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(path.read_bytes())
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--quiet"]
    command += ["--disable-pip-version-check", "--target", str(target), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture
def run(installed, tmp_path):
    """Runs Python beside the installed package; kinds are found when a process starts."""

    def done(*arguments):
        path = os.pathsep.join(filter(None, [str(installed), os.environ.get("PYTHONPATH", "")]))
        environment = os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)

    return done


@pytest.mark.long
def test_it_passes_the_conformance_kit(run):
    # With its own settings and none of our fixtures, as on its author's machine.
    done = run(
        *("-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", SAMPLE / "pyproject.toml"),
        *("--rootdir", SAMPLE, "--confcutdir", SAMPLE, SAMPLE / "tests"),
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert "skipped" not in done.stdout
    assert int(done.stdout.rpartition(" passed")[0].split()[-1]) > 60


@pytest.mark.long
def test_a_rig_file_and_an_instrument_file_use_it(run, small_rig, configs, tmp_path):
    yaml = YAML()
    path = small_rig()
    rig = yaml.load(path)
    for name in ("psg", "psa"):
        rig["axes"][name]["kind"] = "sample_stage"
    rig["camera"]["kind"] = "sample_camera"
    rig["source"]["kind"] = "sample_lamp"
    rig["simulator"]["ports"]["rotators"]["kind"] = "sample_stage"
    rig["simulator"]["ports"]["shutter"]["kind"] = "sample_lamp"
    instrument = yaml.load(configs / "instruments/rgb950.yaml")
    instrument["effects"] = [{"kind": "sample_hum", "parameters": {"amplitude": {"value": 0.3, "unit": "1"}}}]
    for file, tree in (("rig.yaml", rig), ("hum.yaml", instrument)):
        with (tmp_path / file).open("w") as stream:
            yaml.dump(tree, stream)
    acquire = "from acquisition.commands.application import main; import sys; main(sys.argv[1:])"
    done = run("-c", acquire, "--omega", 35, "--rig", "rig.yaml", "--out", "out")
    assert done.returncode == 0, done.stderr
    (capture,) = (tmp_path / "out").glob("*.h5")
    with Capture(capture) as reader:
        for kind in ("sample_stage", "sample_camera", "sample_lamp"):
            assert f'"{kind}"' in reader.header.devices_json
    code = """
import sys
from processing import reduce_to_dataset
for instrument in (None, "hum.yaml"):
    print(reduce_to_dataset(sys.argv[1], instrument).attrs["median_reduced_chi_square"])
"""
    done = run("-c", code, capture)
    assert done.returncode == 0, done.stderr
    without, with_hum = map(float, done.stdout.split())
    # The bench does not hum: a model that says it does, by a third, fits worse; most pixels are dark.
    assert with_hum > 1.2 * without


def test_its_effect_is_searched_and_its_controller_is_served(run, configs):
    code = """
import sys
import numpy as np
from processing.diagnosis.search.candidate import pool
from processing.instrument.changes import Conditions
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from simulators.rig.controller_kinds import served_kinds
model = InstrumentModel.load(sys.argv[1]).at(662)
conditions = Conditions.of(rotating_retarders(1.0).angles_deg)
print(any(c.kind == "sample_hum" for c in pool(model, [conditions])), "sample_stage" in served_kinds())
"""
    done = run("-c", code, configs / "instruments/rgb950.yaml")
    assert done.stdout.split() == ["True", "True"], done.stderr


#: Of each group an entry of another package with a name that is taken, and what reads the group.
TAKEN = {
    "axes": ("zaber = umov_sample.stage", "from drivers.registry import device_kinds as f; f('axes')"),
    "emulators": (
        "other = simulators.controllers.zaber",
        "from simulators.rig.controller_kinds import served_kinds as f; f()",
    ),
    "effects": (
        "psg_azimuth = umov_sample.hum:Hum",
        "from processing.instrument.applied_effects import instrument_effects as f; f()",
    ),
    "reflectance": (
        "first_surface = umov_sample.mirror:Model",
        "from processing.reflectance.base import kinds as f; f()",
    ),
}


def test_a_plug_in_cannot_replace_what_is_here(run, tmp_path):
    folder = tmp_path / "other-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "".join(f"[umov.{group}]\n{entry}\n" for group, (entry, _) in TAKEN.items())
    )
    code = f"import sys, traceback\nsys.path.insert(0, {str(tmp_path)!r})\n"
    for group, (_, read) in TAKEN.items():
        code += f"try:\n    {read}\nexcept Exception as error:\n    print({group!r}, error)\n"
    done = run("-c", code)
    assert [line.split()[0] for line in done.stdout.splitlines() if "which exists already" in line] == list(TAKEN)
