"""The captures of the study: campaigns on the emulated rig, taken by `acquire` itself."""

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
BENCH = Path(__file__).parent / "bench"
#: Where the paper shows its images.
SHOWN_DEG = 35.0
#: Undeclared fault of the second part: the generator's plate was remounted, 2 degrees off.
FAULT = {"kind": "element_error", "element": "psg_retarder", "parameter": "azimuth_deg", "offset": 2.0}


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes
    ----------
    omega_deg : arm angles of the sphere.
    fault_deg : arm angles of the sphere while the fault is there.
    pixels : rows and columns of the camera.
    frames : of a Stokes capture.
    """

    wavelengths_nm: tuple[float, ...] = (451.0, 662.0)
    omega_deg: tuple[float, ...] = tuple(20.0 + 5 * k for k in range(15))
    fault_deg: tuple[float, ...] = (35.0, 60.0, 85.0)
    pixels: int = 400
    frames: int = 8


QUICK = Size(wavelengths_nm=(662.0,), omega_deg=(SHOWN_DEG,), fault_deg=(SHOWN_DEG,), pixels=96, frames=4)


@dataclass(frozen=True)
class Part:
    """One campaign of the study: a folder of captures."""

    name: str
    sample: str
    modes: tuple[str, ...]
    omega_deg: tuple[float, ...]
    effects: tuple[Mapping[str, Any], ...] = ()
    #: Air is taken first: only a known sample shows a fault of a plate.
    air: bool = False


def parts(size: Size) -> tuple[Part, ...]:
    """The sphere at all angles, the body, and the sphere again after a plate was remounted."""
    modes = ("drr", "stokes")
    return (
        Part("sphere", "sphere", modes, size.omega_deg),
        Part("body", "body", modes, (SHOWN_DEG,)),
        Part("fault", "sphere", ("drr",), size.fault_deg, (FAULT,), air=True),
    )


def take_captures(work: Path, size: Size, part: Part) -> Path:
    """Take the missing captures of a part of the study; returns their folder."""
    folder = work / part.name
    folder.mkdir(parents=True, exist_ok=True)
    for mode in part.modes:
        states = {"states": {"kind": "fixed", "states": size.frames}} if mode == "stokes" else {}
        _dump(folder / f"{mode}.yaml", _load(CONFIGS / f"plans/{mode}.yaml") | states)
    rig, campaign = folder / "rig.yaml", folder / "campaign.yaml"
    _dump(rig, _rig(size, part.effects))
    _dump(campaign, _campaign(size, part))
    program = [sys.executable, "-m", "acquisition.commands.application"]
    options = ["--campaign", str(campaign), "--rig", str(rig), "--out", str(folder), "--yes"]
    done = subprocess.run([*program, *options], capture_output=True, text=True, cwd=ROOT, check=False)
    if done.returncode:
        raise SystemExit(f"acquire --campaign {campaign} ended with {done.returncode}:\n{done.stderr[-3000:]}")
    return folder / "captures"


def _rig(size: Size, effects: tuple[Mapping[str, Any], ...]) -> dict[str, Any]:
    rig = _load(CONFIGS / "rigs/simulated.yaml")
    for mode in rig["modes"].values():
        mode["instrument"] = str((CONFIGS / "rigs" / mode["instrument"]).resolve())
    samples = {"sphere": BENCH / "sphere.yaml", "body": BENCH / "body.yaml", "air": CONFIGS / "scenes/air.yaml"}
    rig["simulator"] |= {
        "rows": size.pixels,
        "columns": size.pixels,
        "clock_speed": 50,
        "camera_wait_s": 120,
        "samples": {name: str(path) for name, path in samples.items()},
        "effects": [dict(effect) for effect in effects],
    }
    return dict(rig)


def _campaign(size: Size, part: Part) -> dict[str, Any]:
    air = {"sample": {"kind": "air", "name": "air"}, "omega_deg": 180, "modes": ["drr"]}
    return {
        "kind": "campaign",
        "name": "captures",
        "plans": {mode: f"{mode}.yaml" for mode in part.modes},
        "samples": [{"name": part.sample}],
        "wavelengths_nm": list(size.wavelengths_nm),
        "omega_deg": list(part.omega_deg),
        "exposure_s": {"kind": "auto"},
        "references": [air] if part.air else [],
    }


def _load(path: Path) -> Any:
    return YAML(typ="safe").load(path)


def _dump(path: Path, tree: Mapping[str, Any]) -> None:
    YAML(typ="safe").dump(dict(tree), path)
