"""Blind suite of the reflectance: spheres with one thing wrong, or nothing, or something that is not in the list.

Run by hand; about two seconds a case:

    OPENBLAS_NUM_THREADS=1 python benchmarks/blind_reflectance.py --cases 110

Every case draws the fault, its size, instrument (Mueller or linear Stokes), wavelength and arm angle. `diagnose_object`
gets the capture, the declared instrument, the believed material and geometry, and never the fault. Prints one line for
each case and the counts: detectable is a fault whose own effect, fitted alone, gains over 50 in chi-square on held-out
tiles; right is its name, or a named set that holds it.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from processing.diagnosis.fit import held_out, minimize
from processing.diagnosis.problem import Space
from processing.diagnosis.surface_judge import SurfaceDiagnosis
from processing.diagnosis.surface_problem import SurfaceProblem
from processing.diagnosis.surface_run import diagnose_object
from processing.instrument import InstrumentModel
from simulators.scene import Scene
from simulators.sphere_suite import LISTED, UNLISTED, SphereFault, drawn, take

ROOT = Path(__file__).resolve().parents[1]


def detectable(problem: SurfaceProblem, kind: str) -> bool:
    """Whether the true effect alone gains over 50 on held-out tiles."""
    empty = Space(())
    nothing = held_out(problem, empty, minimize(problem, empty, np.zeros(0)))
    gains = []
    for candidate in problem.pool():
        if candidate.kind == kind:
            space = Space((candidate,))
            gains.append(
                nothing.excess - held_out(problem, space, minimize(problem, space, np.zeros(space.size))).excess
            )
    return max(gains, default=0.0) > 50


def score(fault: SphereFault, d: SurfaceDiagnosis, seen: bool) -> str:
    """One word for a case."""
    names = {e.kind: {i.partition("[")[0] for i in e.indistinguishable_from} for e in d.effects}
    if fault.kind == "none":
        return "silent" if d.verdict == "consistent" else "false alarm"
    if fault.kind == "camera_roll":
        # An analyzer turned as a whole is what these names say.
        right_names = {"channel_azimuth", "psa_azimuth", "analyzer_azimuth"}
        right = all(right_names & {k, *others} for k, others in names.items())
        return d.verdict if not names else "right" if right else "wrong name"
    if fault.kind in UNLISTED:
        if names and fault.kind == "not_degenerate" and all("not_triply_degenerate" in v for v in names.values()):
            return "right"
        return "wrong name" if names else d.verdict
    if not names:
        return "missed" if seen else "not detectable"
    right = [k for k, others in names.items() if fault.kind == k or fault.kind in others]
    if not right:
        return "wrong name"
    return "right" if len(names) == 1 else "right and more"


def deviations(fault: SphereFault, d: SurfaceDiagnosis) -> list[float]:
    """Errors of the parameters in standard errors, where the effect itself is named."""
    out = []
    for e in d.effects:
        if e.kind == fault.kind and set(e.indistinguishable_from) <= {"not_triply_degenerate"}:
            for name, truth in fault.parameters.items():
                p = e.parameters[name]
                if isinstance(p.stderr, float) and not isinstance(p.value, tuple):
                    out.append((p.value - truth) / p.stderr)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=110)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    given = parser.parse_args()
    scene = Scene.load(ROOT / "configs/scenes/red_sphere.yaml")
    kinds = ("none", *LISTED, *UNLISTED)
    counts: dict[str, Counter[str]] = {k: Counter() for k in kinds}
    errors: list[float] = []
    for case in range(given.first, given.first + given.cases):
        random = np.random.default_rng([case, 662])
        kind = kinds[case % len(kinds)]
        declared = InstrumentModel.load(ROOT / f"configs/instruments/{random.choice(['rgb950', 'linear_stokes'])}.yaml")
        nm, omega, light = float(random.choice([451.0, 662.0])), random.uniform(25, 80), random.choice([0.1, 0.4, 1.0])
        fault = drawn(kind, random, scene, declared)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "capture.h5"
            take(path, fault, declared, nm, omega, seed=case, light=light)
            judged, problem = diagnose_object([path], declared, fault.material, scene.object.geometry)
        d = judged.diagnosis
        word = score(fault, d, kind in LISTED and detectable(problem, kind))
        counts[kind][word] += 1
        off = deviations(fault, d)
        errors += off
        named = "; ".join(
            f"{e.kind} {[round(p.value, 3) for p in e.parameters.values()]} or {list(e.indistinguishable_from)}"
            for e in d.effects
        )
        truth = {k: round(float(v), 3) for k, v in fault.parameters.items()}
        line = f"{case:4d} {kind:20s} {declared.name[:12]:12s} {nm:g} {omega:.0f} x{light:g} {d.verdict:16s} {word:14s}"
        print(f"{line} {named} | truth {truth} off {[round(float(o), 1) for o in off]}", flush=True)
    print("\nkind: counts")
    for kind, count in counts.items():
        print(f"{kind:20s} {dict(count)}")
    if errors:
        worst = np.abs(errors)
        print(
            f"parameters: {len(errors)}, within 3 standard errors {np.mean(worst < 3):.3f}, largest {worst.max():.1f}"
        )


if __name__ == "__main__":
    main()
