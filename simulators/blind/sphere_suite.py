"""Captures of a sphere with one undeclared fault: for tests and for the blind suite."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from processing.instrument.model import InstrumentModel
from processing.reflectance import first_surface
from simulators.bench.bench import DETECTOR, SceneImage, SimulatedBench
from simulators.bench.scene import Scene
from simulators.bench.virtual_capture import write_virtual_capture
from simulators.blind import scene_faults
from simulators.blind.undeclared_faults import draw_signed

EXPOSURE_S = 0.02
#: Image size and number of states of a full Mueller and of a linear Stokes capture.
MUELLER, STOKES = (120, 40), (240, 8)
#: In this order one can be put on top of another.
LISTED = (
    "polarized_diffuse",
    "refractive_index",
    "registration",
    "interreflection",
    "arm_zero",
    "illumination_azimuth",
    "analyzer_roll",
)
UNLISTED = ("not_degenerate", "dented", "second_lamp", "slow_turn", "wet_patch", "broad_source")


@dataclass(frozen=True)
class SphereFault:
    """A fault, with the scene and the instrument that have it.

    Attributes
    ----------
    kind : name of the case; parts of two at once are joined with "+".
    scene, instrument : the truth; material : the one declared to the processing.
    parameters : true values by kind of effect, in the units of the effect; empty where it has no counterpart.
    """

    kind: str
    scene: SceneImage
    instrument: InstrumentModel
    material: Any
    parameters: dict[str, dict[str, float]] = field(default_factory=dict)


def drawn(kind: str, random: np.random.Generator, scene: Scene, instrument: InstrumentModel) -> SphereFault:
    """A fault of a kind, its size drawn. "none" is a true model, "two" two of `LISTED` at once.

    Of the kinds in `UNLISTED` no effect is known to `diagnose`.
    """
    nothing = SphereFault("none", scene, instrument, scene.material)
    if kind == "none":
        return nothing
    if kind == "two":
        first, second = sorted(random.choice(len(LISTED), 2, replace=False))
        pair = _add_fault(LISTED[second], random, _add_fault(LISTED[first], random, nothing))
        return replace(pair, kind=f"{LISTED[first]}+{LISTED[second]}")
    if kind in LISTED:
        return replace(_add_fault(kind, random, nothing), kind=kind)
    return replace(nothing, kind=kind, scene=_unlisted_scene(kind, random, scene))


def first_surface_of(material: Any) -> first_surface.Model:
    """The material without its diffuse term: what Jarecki and Kupinski's story starts with."""
    plain = {nm: first_surface.Constants(n=c.n, k=c.k) for nm, c in material.constants.items()}
    return first_surface.Model(name="first surface alone", constants=plain)


def _add_fault(kind: str, random: np.random.Generator, so_far: SphereFault) -> SphereFault:
    scene, instrument, truth = so_far.scene, so_far.instrument, dict[str, float]()
    if kind == "arm_zero":
        truth = {"arm": draw_signed(random, 0.7, 4.0)}
        return _extend(so_far, kind, truth, scene=scene_faults.ArmZeroFault(scene, truth["arm"]))
    if kind in ("illumination_azimuth", "analyzer_roll"):
        turn = scene_faults.turned_generator if kind == "illumination_azimuth" else scene_faults.turned_analyzer
        truth = {"azimuth": draw_signed(random, 0.4, 5.0)}
        return _extend(so_far, kind, truth, instrument=turn(instrument, truth["azimuth"]))
    if not isinstance(scene, Scene):
        raise ValueError(f"{kind} has to be put in before what stands in front of the scene")
    if kind == "registration":
        truth = {n: random.uniform(-s, s) for n, s in (("x", 0.8), ("y", 0.8), ("scale", 0.03))}
        shifted = scene_faults.moved_sphere(scene, truth["x"], truth["y"], truth["scale"])
        return _extend(so_far, kind, truth, scene=shifted)
    if kind == "interreflection":
        towards, uneven = random.uniform(0, 2 * math.pi), random.uniform(0, 0.6)
        support = scene_faults.LitSupport(
            scene,
            strength=random.uniform(0.15, 0.6),
            radius_mm=random.uniform(14, 30),
            below_mm=random.uniform(22, 45),
            uneven=(uneven * math.cos(towards), uneven * math.sin(towards)),
        )
        return _extend(so_far, kind, {}, scene=support)
    if kind == "polarized_diffuse":
        a, b = float(np.exp(random.uniform(np.log(0.02), np.log(0.3)))), random.uniform(1.5, 3.0)
        constants = so_far.material.constants
        true = {nm: c.model_copy(update={"a": a, "b": b}) for nm, c in constants.items()}
        believed = first_surface_of(so_far.material)
        surface = Scene(scene.spec, so_far.material.model_copy(update={"constants": true}))
        # Without a diffuse term the model's exponent stands at 2.
        return _extend(so_far, kind, {"a": a, "log_b": float(np.log(b / 2))}, scene=surface, material=believed)
    if kind == "refractive_index":
        truth = {"n": random.uniform(-0.2, 0.2), "k": random.uniform(-0.06, 0.07)}
        changed = {
            nm: c.model_copy(update={"n": c.n - truth["n"], "k": c.k - truth["k"]})
            for nm, c in so_far.material.constants.items()
        }
        return _extend(so_far, kind, truth, material=so_far.material.model_copy(update={"constants": changed}))
    raise ValueError(f"no fault {kind!r}; there are none, two, {', '.join((*LISTED, *UNLISTED))}")


def _extend(so_far: SphereFault, kind: str, truth: dict[str, float], **changed: Any) -> SphereFault:
    return replace(so_far, parameters={**so_far.parameters, kind: truth}, **changed)


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
    if kind == "wet_patch":
        return scene_faults.WetPatch(scene, random.uniform(-40, 60), random.uniform(-40, 40), random.uniform(10, 30))
    if kind == "broad_source":
        return scene_faults.BroadSource(scene, random.uniform(4, 12))
    raise ValueError(f"no fault {kind!r}; there are none, two, {', '.join((*LISTED, *UNLISTED))}")


def take(
    path: Path,
    fault: SphereFault,
    declared: InstrumentModel,
    wavelength_nm: float,
    *,
    omega_deg: float,
    seed: int,
    light: float = 1.0,
) -> None:
    """Write a capture of the fault under the declared instrument; `light` 1 fills 80 % of the full well."""
    size, states = STOKES if declared.mosaic else MUELLER
    true = fault.instrument.at(wavelength_nm)
    small = SimulatedBench(fault.scene, true, wavelength_nm, rows=size // 4, columns=size // 4, flux_e_per_s=1.0)
    brightest = max(
        float(small.expected_electrons({"psg": 9.0 * n, "psa": 4.91 * 9.0 * n}, 1.0, omega_deg=omega_deg).max())
        for n in range(0, 40, 5)
    )
    flux = light * 0.8 * float(DETECTOR.full_well_e or 1e4) / (brightest * EXPOSURE_S)
    bench = SimulatedBench(
        fault.scene, fault.instrument, wavelength_nm, rows=size, columns=size, flux_e_per_s=flux, seed=seed
    )
    write_virtual_capture(path, bench, declared, omega_deg, exposure_s=EXPOSURE_S, states=states, name=path.stem)
