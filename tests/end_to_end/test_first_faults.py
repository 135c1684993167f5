"""Faults that a newcomer sets on the simulated rig and declares nowhere, by the commands of the documents.

The rig has its 600 x 600 pixels and its default seed. Each runs also beside a busy loop on every core, where stamps of
frames are late. A wedge of 0.2 pixel is the example of docs/closing-the-loop.md (test_docs_blocks.py).
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass

import pytest

from acquisition.demo.truth import true_error
from processing.commands import diagnose as diagnose_cli
from processing.commands.application import main as process
from simulators.bench.scene import Scene
from tests.commands import exit_code

SLOW = pytest.mark.skipif(not os.environ.get("UMOV_SLOW"), reason="half a minute each; UMOV_SLOW=1 runs them")


@dataclass(frozen=True)
class Case:
    """Lines of the rig file, the names that are right, and the capture that is diagnosed."""

    effects: tuple[dict, ...]
    right: frozenset[str]
    omega: int = 35
    sample: str = "red_sphere"


CASES = {
    "nothing": Case((), frozenset()),
    "wedge of 0.3 pixel": Case(
        ({"kind": "image_drift", "axis": "psa", "wedge_pixels": 0.3},), frozenset({"beam_wander"})
    ),
    "eccentricity of 0.6 degrees": Case(
        ({"kind": "angle_wobble", "axis": "psg", "amplitude_deg": 0.6},), frozenset({"rotation_eccentricity"})
    ),
    "lamp drift of 2 %": Case(({"kind": "source_drift", "fraction_per_hour": 2.0},), frozenset({"source_drift"})),
    "lamp drift of 3 %": Case(({"kind": "source_drift", "fraction_per_hour": 3.0},), frozenset({"source_drift"})),
    "plate of 2 % and a drift": Case(
        (
            {"kind": "plate_transmission", "axis": "psg", "amplitude": 0.02},
            {"kind": "source_drift", "fraction_per_hour": 1.0},
        ),
        frozenset({"retarder_transmission", "source_drift"}),
    ),
    "window of 6 degrees, air": Case(
        ({"kind": "window", "behind": "psg_polarizer", "retardance_deg": 6.0},),
        frozenset({"generator_ellipticity"}),
        180,
        "air",
    ),
}


@pytest.fixture
def busy(request):
    """A loop for each core, that does nothing else."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    yield
    for loop in loops:
        loop.kill()
        loop.wait()


def run(main, *words) -> None:
    assert exit_code(main, *words) == 0, words


def check(case: Case, acquire, rig, configs, folder, capfd) -> None:
    """Take, reduce, diagnose, write and reduce again: no wrong name is sure, M gets better or stays."""
    code, _, err = acquire("--omega", case.omega, "--sample", case.sample, "--rig", rig, "--out", folder)
    assert code == 0, err
    (capture,) = folder.glob("*.h5")
    file, new, corrected = folder / "said.json", folder / "new.yaml", folder / "again.h5"
    instrument = configs / "instruments/rgb950.yaml"
    run(diagnose_cli.main, capture, "--instrument", instrument, "--write", new, "--json", file)
    run(process, "reduce", capture, "--no-figure")
    run(process, "reduce", capture, "--instrument", new, "--out", corrected, "--no-figure")
    report = json.loads(file.read_text())
    names = {(e["kind"], *(n.partition("[")[0] for n in e["indistinguishable_from"])) for e in report["effects"]}
    sure = {e["kind"] for e in report["effects"] if e["answer"] == "sure" and e["confident"]}
    assert all(case.right & set(equal) for equal in names if equal[0] in sure)
    assert bool(report["effects"]) == bool(case.effects)
    errors = []
    scene = Scene.load(configs / "scenes" / f"{case.sample}.yaml")
    for product in (capture.with_suffix(".mueller.h5"), corrected):
        xi0 = product.with_suffix(".xi0.h5")
        run(process, "xi0", product, "--out", xi0, "--no-figure")
        errors.append(true_error(product, xi0, scene).mueller_rms)
    with capfd.disabled():
        shown = "; ".join(f"{'/'.join(equal)}{' (sure)' if equal[0] in sure else ''}" for equal in sorted(names))
        print(f"\n| {report['verdict']} | {shown or 'no name'} | {errors[0]:.5f} to {errors[1]:.5f} |", flush=True)
    assert errors[1] <= 1.01 * errors[0]
    assert not case.effects or report["correction"]["refused"] is None


@SLOW
@pytest.mark.parametrize("load", ["quiet", "busy"])
@pytest.mark.parametrize("name", CASES)
def test_a_first_fault_is_found(name, load, acquire, small_rig, configs, tmp_path, capfd, request):
    if load == "busy":
        request.getfixturevalue("busy")
    rig = small_rig(effects=list(CASES[name].effects), rows=600, columns=600, clock_speed=10)
    check(CASES[name], acquire, rig, configs, tmp_path, capfd)
