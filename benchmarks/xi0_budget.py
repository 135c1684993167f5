"""Fig. 11 of the paper: what makes the deviation of xi0 on the bench of `./lab paper`, each cause switched off.

    .venv/bin/python benchmarks/xi0_budget.py --work FOLDER

Captures come straight from the simulated bench. Besides, without noise and pixel by pixel: xi0 for each order of the
small eigenvalues, and what tables of one-degree bins make of the true xi0.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from itertools import permutations
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from paper_study.acquire import BENCH, CONFIGS

from processing.arrays import Array
from processing.campaign.executors import executor
from processing.campaign.run import ProcessedCampaign
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.polarization import mueller
from processing.polarization.xi0 import estimate
from processing.reflectance.tables import ScatteringTable
from processing.yaml_file import dump_yaml
from simulators.bench import scene as scenes
from simulators.bench.bench import DETECTOR, SimulatedBench
from simulators.bench.scene import Scene
from simulators.bench.virtual_capture import write_virtual_capture

OMEGA_DEG = tuple(range(20, 91, 5))
SPHERE, TABLE_I = CONFIGS / "geometries/one_inch_sphere.yaml", CONFIGS / "materials/red_print.yaml"
#: A detector of 1e8 electrons: shot noise and rounding of 1e-4.
QUIET = DETECTOR.model_copy(update={"full_well_e": 1e8, "gain_e_per_count": 1.6e3, "bits": 16, "read_noise_e": 0.0})
CAUSES = ("noise", "registration", "constants", "eigenvalues")
INSTRUMENTS = {"rgb950": ("drr", 40), "linear_stokes": ("stokes", 8)}


def bench_sphere(nm: float, deviation: float | None = None) -> Scene:
    scene = Scene.load(BENCH / "sphere.yaml")
    spec = scene.object
    if deviation is not None:
        surface = spec.surface[nm].model_copy(update={"eigenvalue_deviation": deviation})
        spec = spec.model_copy(update={"surface": {nm: surface}})
    return Scene(spec, scene.material)


def flux(scene: Scene, model: InstrumentModel, nm: float, omega: float, *, full_well_e: float) -> float:
    """Electrons a second that bring the brightest pixel to 80 % of the full well in 0.02 s."""
    bench = SimulatedBench(scene, model, nm, rows=100, columns=100, flux_e_per_s=1.0)
    angles = ({"psg": 9.0 * n, "psa": 4.91 * 9.0 * n} for n in range(0, 40, 3))
    brightest = max(float(bench.expected_electrons(a, 1.0, omega_deg=omega).max()) for a in angles)
    return 0.8 * full_well_e / (0.02 * brightest)


def campaign(work: Path, nm: float, on: set[str], extinction: float = 0.0) -> Array:
    """RMSD of xi0 in % and its noise, by Omega (2, n), with these causes alone."""
    scene = bench_sphere(nm, None if "eigenvalues" in on else 0.0)
    captures = work / "captures"
    captures.mkdir(parents=True)
    detector = DETECTOR if "noise" in on else QUIET
    for name, (_, states) in INSTRUMENTS.items():
        declared = InstrumentModel.load(CONFIGS / f"instruments/{name}.yaml")
        true = declared
        if extinction and name == "linear_stokes":
            values = {f"channel_{c.name}": EffectParameter(value=extinction, unit="1") for c in declared.channels}
            effect = AppliedEffect(kind="channel_extinction", parameters=values, scope="instrument")
            true = declared.model_copy(update={"effects": (effect,)})
        for omega in OMEGA_DEG:
            level = flux(scene, declared, nm, omega, full_well_e=float(detector.full_well_e or 1e4))
            size: dict[str, Any] = {"rows": 400, "columns": 400, "detector": detector, "seed": omega}
            bench = SimulatedBench(scene, true, nm, flux_e_per_s=level, **size)
            write_virtual_capture(captures / f"{name}_{omega}.h5", bench, declared, omega, states=states)
    material = BENCH / "material.yaml" if "constants" not in on else TABLE_I
    geometry = work / "true.yaml"
    geometry.write_text(dump_yaml(scene.object.geometry), encoding="utf-8")
    place = SPHERE if "registration" in on else geometry
    with executor(1) as pool:
        rows = ProcessedCampaign(captures, work / "out", place, material).run(pool).rows
    return np.array([[row.xi0_percent for row in rows], [row.xi0_noise_percent for row in rows]])


def split(axes: tuple[int, ...]) -> Callable[[Array, Array, Array], Array]:
    """`split_eigenvalues` with the larger and the smaller process of another order."""

    def shifted(m: Array, jones: Array, shift: Array) -> Array:
        v = jones.reshape(-1, 4) / np.linalg.norm(jones.reshape(-1, 4), axis=-1, keepdims=True)
        v = v * -np.exp(-1j * np.angle(v[:, :1]))
        w = np.eye(4)[0] - v
        w /= np.linalg.norm(w, axis=-1, keepdims=True)
        plus, minus = (np.eye(4)[k] - 2 * w * w[:, k : k + 1].conj() for k in axes)
        h = plus[:, :, None] * plus[:, None, :].conj() - minus[:, :, None] * minus[:, None, :].conj()
        return np.asarray(m + (2 * m[:, 0, 0] * shift)[:, None, None] * mueller.coherency_to_mueller(h))

    return shifted


def pixel_by_pixel(nm: float, deviation: float | None = None) -> Iterator[float]:
    """RMSD of xi0 in % from exact intensities under the right material and geometry, by Omega."""
    scene = bench_sphere(nm, deviation)
    w = InstrumentModel.load(CONFIGS / "instruments/linear_stokes.yaml").at(nm).rows({"": np.zeros(1)})[0]
    for omega in OMEGA_DEG:
        truth = scene.truth(omega, nm, 200, 200)
        m = scene.mueller_image(omega, nm, 200, 200)[truth.mask].reshape(-1, 16).astype(float)
        found = estimate(w @ m.T, None, w, scene.optics.mueller_jones(truth.geometry.points, nm))
        off = (found.xi0 - truth.xi0[truth.mask])[found.condition <= 100]
        yield 100 * float(np.sqrt(np.nanmean(off**2)))


def through_tables(nm: float) -> Iterator[float]:
    """RMSD in % of the true xi0 through two tables of images of 400 and 301 pixels, by Omega."""
    scene, tables = bench_sphere(nm), [ScatteringTable(("xi0",), nm) for _ in range(2)]
    for omega in OMEGA_DEG:
        for size, table in zip((400, 301), tables, strict=True):
            truth = scene.truth(omega, nm, size, size)
            table.add(truth.geometry.points.angles, truth.xi0[truth.mask][None])
    for omega in OMEGA_DEG:
        angles = scene.truth(omega, nm, 400, 400).geometry.points.angles
        a, b = (table.lookup(angles)[0] for table in tables)
        yield 100 * float(np.sqrt(np.nanmean((a - b) ** 2)))


def line(name: str, values: Array) -> None:
    v = np.asarray(values)
    print(f"{name:<44}", f"{v.mean():7.2f} {v[:13].mean():7.2f} ", " ".join(f"{x:6.1f}" for x in v), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--nm", type=float, default=451.0)
    given = parser.parse_args()
    nm, every = given.nm, set(CAUSES)
    print(f"{nm:g} nm; mean over Omega, mean up to 80 degrees, Omega {OMEGA_DEG}")
    line("one-degree bins alone, pixel by pixel", np.array(list(through_tables(nm))))
    for deviation in (0.0, 0.03, 0.06, 0.09):
        line(f"eigenvalues {deviation:g} apart, pixel by pixel", np.array(list(pixel_by_pixel(nm, deviation))))
    for axes in permutations((1, 2, 3), 2):
        scenes.split_eigenvalues = split(axes)
        line(f"small processes {axes}, pixel by pixel", np.array(list(pixel_by_pixel(nm))))
    scenes.split_eigenvalues = split((1, 3))
    cases: dict[str, tuple[set[str], float]] = {"everything": (every, 0.0), "nothing": (set(), 0.0)}
    for cause in CAUSES:
        cases[f"without {cause}"] = every - {cause}, 0.0
        cases[f"{cause} alone"] = {cause}, 0.0
    cases["channels of extinction 1:100 alone"] = set(), 0.01
    for name, (on, extinction) in cases.items():
        work = given.work / f"{nm:g} {name}".replace(" ", "_")
        found = campaign(work, nm, on, extinction)
        line(name, found[0])
        line(f"{name}, noise predicted", found[1])


if __name__ == "__main__":
    main()
