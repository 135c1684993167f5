"""Our `.pbsdf` in Mitsuba, and our Fresnel matrices beside Mitsuba's: axes, order and signs against others' code.

Run: .venv/bin/python benchmarks/renderer_check.py [--mitsuba /path/to/python]
Makes an environment with mitsuba in ~/.cache/umov/mitsuba on first use; the renderer runs in a process of its own
(variant scalar_spectral_polarized, which needs no LLVM). Takes about two minutes, 1 GB in a temporary folder.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import venv
from pathlib import Path
from typing import Any

import numpy as np

from processing.geometry.frames import ScatteringGeometry, cross, dot, transverse_axes
from processing.geometry.rusinkiewicz import Angles, directions
from processing.polarization import mueller
from processing.reflectance import pbsdf
from processing.reflectance.base import load_reflectance, normalized_mueller
from processing.reflectance.fresnel import jones
from processing.reflectance.table_axes import SHAPE, TableAxes
from processing.reflectance.tables import ScatteringTable

HERE = Path(__file__).parent
NORMAL = np.array([0.0, 0.0, 1.0])
WAVELENGTH_NM = 662.0


class Renderer:
    """Mitsuba in a child process."""

    def __init__(self, python: Path, folder: Path) -> None:
        self.folder = folder
        self._process = subprocess.Popen(
            [str(python), str(HERE / "renderer_side.py")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.version = self._answer()["mitsuba"]

    def _answer(self) -> Any:
        if self._process.stdout is None:
            raise RuntimeError("the renderer has no output")
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"the renderer ended with {self._process.wait()}; its message stands above")
        return json.loads(line)

    def evaluate(self, bsdf: dict[str, Any], geometry: ScatteringGeometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M (N, 4, 4), BRDF times the source's cosine, and the x axes (N, 3) to which its Stokes vectors refer."""
        question: dict[str, Any] = {"bsdf": bsdf, "wavelength_nm": WAVELENGTH_NM}
        for name in ("to_source", "to_camera"):
            question[name] = str(self.folder / f"{name}.npy")
            np.save(question[name], getattr(geometry, name))
        question["out"] = str(self.folder / "answer.npz")
        if self._process.stdin is None:
            raise RuntimeError("the renderer has no input")
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        self._answer()
        with np.load(question["out"]) as answer:
            return answer["m"], answer["x_in"], answer["x_out"]

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()


def referred_to(m: np.ndarray, geometry: ScatteringGeometry, x_in: np.ndarray, x_out: np.ndarray) -> np.ndarray:
    """Matrices in our instrument frames, referred to other x axes of both beams."""
    turns = []
    for k, ours, theirs in (
        (-geometry.to_source, geometry.axes_in[0], x_in),
        (geometry.to_camera, geometry.axes_out[0], x_out),
    ):
        turns.append(np.arctan2(dot(k, cross(ours, theirs)), dot(ours, theirs)))
    return mueller.rotation(-turns[1]) @ m @ mueller.rotation(turns[0])


def random_geometry(count: int, seed: int) -> ScatteringGeometry:
    """Both directions up to 75 degrees from the normal."""
    rng = np.random.default_rng(seed)
    both = []
    for _ in range(2):
        height, azimuth = rng.uniform(np.cos(np.deg2rad(75)), 1, count), rng.uniform(-np.pi, np.pi, count)
        across = np.sqrt(1 - height**2)
        both.append(np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height], axis=-1))
    return ScatteringGeometry(np.broadcast_to(NORMAL, both[0].shape), *both)


def upright(geometry: ScatteringGeometry) -> ScatteringGeometry:
    """The same points turned so that every normal is +z, as in the renderer's surface frame."""
    n = geometry.normal
    x, y = transverse_axes(n, np.array([0.3, 0.9, 0.1]))
    turn = np.stack([x, y, n], axis=-2)
    a, b = (np.einsum("nij,nj->ni", turn, v) for v in (geometry.to_source, geometry.to_camera))
    return ScatteringGeometry(np.broadcast_to(NORMAL, a.shape), a, b)


def dominant_process(model: Any, geometry: ScatteringGeometry) -> np.ndarray:
    """Mueller-Jones matrices in the facet's axes. The diffuse term of the paper belongs to the instrument that looks
    (docs/conventions.md), so it is evaluated in the instrument's pose of these angles.
    """
    pose = ScatteringGeometry(*directions(*geometry.angles))
    return pbsdf.to_renderer_frames(model.mueller_jones(pose, WAVELENGTH_NM), pose)


def fill(model: Any) -> ScatteringTable:
    """A table of a model at every bin centre whose directions are above the surface."""
    axes = TableAxes("renderer")
    table = ScatteringTable(pbsdf.MUELLER, WAVELENGTH_NM, "renderer", simulated=True, frames="renderer")
    for i in range(SHAPE[0]):
        bins = np.arange(i * SHAPE[1] * SHAPE[2], (i + 1) * SHAPE[1] * SHAPE[2])
        angles = axes.angles(bins)
        n, wi, wo = directions(*angles)
        up = (dot(n, wi) > 0) & (dot(n, wo) > 0) & (bins % SHAPE[2] != SHAPE[2] - 1)
        if not up.any():
            continue
        geometry = ScatteringGeometry(n[up], wi[up], wo[up])
        table.add(Angles(*(a[up] for a in angles)), dominant_process(model, geometry).reshape(-1, 16).T)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mitsuba", type=Path, help="Python that has mitsuba")
    python = parser.parse_args().mitsuba or environment()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        renderer = Renderer(python, folder)
        print(f"mitsuba {renderer.version}, variant scalar_spectral_polarized")
        conductor(renderer)
        exported(renderer, folder)
        renderer.close()


def conductor(renderer: Renderer) -> None:
    """Our first-surface matrix beside the renderer's rough conductor, which knows nothing of our files."""
    geometry = random_geometry(300, 1)
    for n, k in ((1.3, 0.08), (1.5, 0.0), (0.27, 2.8)):
        bsdf = {"type": "roughconductor", "alpha": 0.6}
        bsdf |= {"eta": {"type": "uniform", "value": n}, "k": {"type": "uniform", "value": k}}
        theirs, x_in, x_out = renderer.evaluate(bsdf, geometry)
        theirs = theirs / theirs[:, :1, :1]
        ours = referred_to(normalized_mueller(jones(geometry, complex(n, k))), geometry, x_in, x_out)
        flip = np.diag([1.0, 1, 1, -1])
        plain, mirrored = (np.abs(m - theirs).max() for m in (ours, flip @ ours @ flip))
        print(
            f"first surface, n = {n:g} + {k:g} i: largest difference {plain:.1e} (with S3 turned round {mirrored:.1e})"
        )


def exported(renderer: Renderer, folder: Path) -> None:
    """A table of the red print's dominant process, exported and evaluated by the renderer."""
    model = load_reflectance(HERE.parent / "configs/materials/red_print.yaml")
    table = fill(model)
    pbsdf.export([table], folder / "red.pbsdf", empty="nearest")
    bsdf = {"type": "measured_polarized", "filename": str(folder / "red.pbsdf"), "wavelength": WAVELENGTH_NM}
    rng = np.random.default_rng(2)
    some = table.axes.angles(rng.choice(table.bins, 400, replace=False))
    n, wi, wo = directions(*some)
    # At theta_h = 0 or theta_d = 0 the renderer's own phi_d is 0/0, and it returns black.
    inside = (dot(n, wi) > 0.1) & (dot(n, wo) > 0.1) & (some.theta_d > 0.02) & (some.theta_h > 0)
    centres = upright(ScatteringGeometry(n[inside], wi[inside], wo[inside]))
    for where, geometry in (("bin centres", centres), ("random directions", random_geometry(400, 3))):
        theirs, x_in, x_out = renderer.evaluate(bsdf, geometry)
        ours = referred_to(dominant_process(model, geometry), geometry.with_up(geometry.half), x_in, x_out)
        brdf = theirs[:, 0, 0] * np.pi
        difference = np.abs(theirs * np.pi - ours).reshape(-1, 16)
        print(f"exported table at {len(ours)} {where}: M00 {np.median(brdf):.4f} (1 expected), elements differ by")
        largest = difference.max(axis=1)
        middle, most = np.median(difference), np.percentile(largest, 99)
        print(f"  {middle:.1e} (median), {largest.max():.1e} (most), {most:.1e} (99 %)")


def environment() -> Path:
    """Python with mitsuba; installed once."""
    folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "umov/mitsuba"
    python = folder / "bin/python"
    if not (folder / "complete").exists():
        print(f"making an environment for mitsuba in {folder} (once, about a minute)", flush=True)
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", "mitsuba==3.9.1", "numpy"], check=True)
        (folder / "complete").touch()
    return python


if __name__ == "__main__":
    main()
