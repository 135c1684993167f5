"""Captures of a sphere with one thing wrong that the processing is not told: for tests and for the blind suite."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from processing.instrument import InstrumentModel
from processing.reflectance import first_surface
from simulators import scene_faults
from simulators.bench import DETECTOR, SceneImage, SimulatedBench
from simulators.scene import Scene
from simulators.virtual_capture import write_virtual_capture

EXPOSURE_S = 0.02
#: Image size and number of states of a full Mueller and of a linear Stokes capture.
MUELLER, STOKES = (120, 40), (240, 8)
LISTED = (
    "polarized_diffuse",
    "registration",
    "arm_zero",
    "illumination_azimuth",
    "interreflection",
    "refractive_index",
)
UNLISTED = ("not_degenerate", "camera_roll", "dented", "second_lamp", "slow_turn")


@dataclass(frozen=True)
class SphereFault:
    """What is wrong: kind, true parameters in the units of the effect, and what makes it so."""

    kind: str
    scene: SceneImage
    instrument: InstrumentModel
    material: object
    parameters: dict[str, float] = field(default_factory=dict)


def drawn(kind: str, random: np.random.Generator, scene: Scene, instrument: InstrumentModel) -> SphereFault:
    """A fault of a kind, its size drawn; `material` is what the processing believes, the rest is what is true.

    "none" is a true model. Of the kinds in `UNLISTED` no effect is known to `diagnose`.
    """
    material = scene.material
    if kind == "none":
        return SphereFault(kind, scene, instrument, material)
    if kind in ("polarized_diffuse", "refractive_index"):
        return _of_material(kind, random, scene, instrument)
    if kind == "registration":
        x, y, scale = random.uniform(-1, 1, 3) * (0.8, 0.8, 0.03)
        moved = scene_faults.moved_sphere(scene, x, y, scale)
        return SphereFault(kind, moved, instrument, material, {"x": x, "y": y, "scale": scale})
    if kind == "arm_zero":
        error = _signed(random, 0.7, 4.0)
        return SphereFault(kind, scene_faults.ArmZero(scene, error), instrument, material, {"arm": error})
    if kind == "illumination_azimuth":
        error = _signed(random, 0.4, 5.0)
        turned = scene_faults.turned_generator(instrument, error)
        return SphereFault(kind, scene, turned, material, {"azimuth": error})
    if kind == "interreflection":
        lit = scene_faults.LitSupport(scene, random.uniform(0.15, 0.6))
        return SphereFault(kind, lit, instrument, material)
    if kind == "camera_roll":
        return SphereFault(kind, scene, scene_faults.turned_analyzer(instrument, _signed(random, 1, 5)), material)
    return SphereFault(kind, _unlisted_scene(kind, random, scene), instrument, material)


def _of_material(kind: str, random: np.random.Generator, scene: Scene, instrument: InstrumentModel) -> SphereFault:
    constants = getattr(scene.material, "constants", {})
    if kind == "polarized_diffuse":
        plain = {nm: first_surface.Constants(n=c.n, k=c.k) for nm, c in constants.items()}
        believed = first_surface.Model(name="first surface alone", constants=plain)
        return SphereFault(kind, scene, instrument, believed)
    dn, dk = random.uniform(-0.2, 0.2), random.uniform(-0.06, 0.1)
    wrong = {nm: c.model_copy(update={"n": c.n - dn, "k": max(c.k - dk, 0.0)}) for nm, c in constants.items()}
    material = scene.material.model_copy(update={"constants": wrong})  # type: ignore[union-attr]
    return SphereFault(kind, scene, instrument, material, {"n": dn})


def _unlisted_scene(kind: str, random: np.random.Generator, scene: Scene) -> SceneImage:
    if kind == "not_degenerate":
        shift = random.uniform(0.01, 0.06)
        surface = {nm: s.model_copy(update={"eigenvalue_deviation": shift}) for nm, s in scene.object.surface.items()}
        return Scene(scene.object.model_copy(update={"surface": surface}), scene.material)
    if kind == "dented":
        return scene_faults.Dented(scene, random.uniform(2, 8), random.uniform(2, 5))
    if kind == "second_lamp":
        return scene_faults.SecondLamp(scene, random.uniform(-120, -40), random.uniform(0.05, 0.4))
    if kind == "slow_turn":
        return scene_faults.SlowTurn(scene, random.uniform(2, 8))
    raise ValueError(f"no fault {kind!r}; there are none, {', '.join((*LISTED, *UNLISTED))}")


def take(
    path: Path,
    fault: SphereFault,
    declared: InstrumentModel,
    wavelength_nm: float,
    omega_deg: float,
    seed: int,
    light: float = 1.0,
) -> None:
    """Write a capture of the fault under the declared instrument; `light` 1 fills 80 % of the full well."""
    size, states = STOKES if declared.mosaic else MUELLER
    true = fault.instrument.at(wavelength_nm)
    small = SimulatedBench(fault.scene, true, wavelength_nm, size // 4, size // 4, flux_e_per_s=1.0)
    brightest = max(
        float(small.expected_electrons({"psg": 9.0 * n, "psa": 4.91 * 9.0 * n}, 1.0, omega_deg=omega_deg).max())
        for n in range(0, 40, 5)
    )
    flux = light * 0.8 * float(DETECTOR.full_well_e or 1e4) / (brightest * EXPOSURE_S)
    bench = SimulatedBench(fault.scene, fault.instrument, wavelength_nm, size, size, flux_e_per_s=flux, seed=seed)
    write_virtual_capture(path, bench, declared, omega_deg, EXPOSURE_S, states=states, name=path.stem)


def _signed(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))) * random.choice([-1, 1]))
