"""The paper's story with both instruments, for docs/studies/reflectance.md: numbers, and the figure.

    python benchmarks/closing_loop_reflectance.py --figure docs/images/closing_loop_reflectance.png

A sphere at 662 nm, Omega 35, is processed with first surface alone; `diagnose_object` says what lacks; psi, |D| and xi0
against the truth before and after.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from processing.arrays import Array
from processing.diagnosis.surface.diagnose import diagnose_object
from processing.diagnosis.surface.write import corrected_material
from processing.instrument.model import InstrumentModel
from processing.maps.xi0 import estimate_from_stokes
from processing.polarization.image_difference import linear_diattenuation, magnitude, orientation_difference, rmsd
from processing.reduction.stokes import reduce_stokes
from processing.storage.captures.capture import Capture
from processing.storage.products.images import StokesImage
from processing.storage.products.product import Step
from simulators.bench.scene import Scene
from simulators.blind.sphere_suite import SphereFault, first_surface_of, take

ROOT = Path(__file__).resolve().parents[1]
NM, OMEGA_DEG, BORDER = 662.0, 35.0, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    scene = Scene.load(ROOT / "configs/scenes/red_sphere.yaml")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        captures, instruments = {}, {}
        for kind in ("rgb950", "linear_stokes"):
            instruments[kind] = InstrumentModel.load(ROOT / f"configs/instruments/{kind}.yaml")
            fault = SphereFault("the paper's", scene, instruments[kind], first_surface_of(scene.material))
            captures[kind] = folder / f"{kind}.h5"
            take(captures[kind], fault, instruments[kind], NM, OMEGA_DEG, seed=1)
        plain = fault.material
        product = folder / "stokes.h5"
        with Capture(captures["linear_stokes"]) as capture:
            model = instruments["linear_stokes"].at(NM)
            reduce_stokes(capture, model, product, (Step("reduce", {}),), overwrite=True)
        image = StokesImage.load(product)
        rows = [["first surface alone", plain]]
        for kind, path in captures.items():
            judged, _ = diagnose_object([path], instruments[kind], plain, scene.object.geometry)
            d = judged.diagnosis
            print(f"{kind}: {d.verdict}, {[e.kind for e in d.effects]}, {d.constants}")
            print(
                f"   rms {d.error_before.rms_percent:.3f} -> {d.error_after.rms_percent:.3f} %, floor "
                f"{d.noise_floor_percent:.3f} %, chi2/dof {d.error_before.chi2_reduced:.3f} -> "
                f"{d.error_after.chi2_reduced:.3f}, evidence {d.effects[0].evidence:.0f}"
            )
            print("   " + ", ".join(f"{n} {p.value:.4f} +- {p.stderr:.4f}" for n, p in d.effects[0].parameters.items()))
            rows.append(
                [
                    f"with what the {'Mueller' if kind == 'rgb950' else 'Stokes'} capture found",
                    corrected_material(plain, d),
                ]
            )
        rows.append(["the true material: noise alone", scene.material])
        maps = [compared(scene, image, material) for _, material in rows]
        for (title, _), m in zip(rows, maps, strict=True):
            print(f"{title}: psi {m['psi_rms']:.2f} deg, |D| {m['size_rms']:.2f} %, xi0 {m['xi0_rms']:.4f}")
        if given.figure:
            draw(["before", "after"], maps[:2]).savefig(given.figure, dpi=80)


def compared(scene: Scene, image: StokesImage, material: Any) -> dict[str, Any]:
    """Maps of the errors of psi, |D| and xi0 against the truth, and their rms inside the outline."""
    from scipy.ndimage import binary_erosion

    shape = image.mask.shape
    truth = scene.truth(OMEGA_DEG, NM, *shape)
    geometry = truth.geometry
    if geometry is None or scene.material is None:
        raise TypeError("the story needs an object")
    models = [linear_diattenuation(m.mueller_jones(geometry.points, NM)) for m in (material, scene.material)]
    m0 = np.asarray(geometry.fill(material.mueller_jones(geometry.points, NM)), dtype=float)
    found = estimate_from_stokes(image, m0)
    inside = binary_erosion(truth.mask, iterations=BORDER)
    psi = geometry.fill(np.rad2deg(orientation_difference(*models)))
    size = geometry.fill(100 * (magnitude(models[0]) - magnitude(models[1])))
    xi0 = np.where(found.valid & inside, found.xi0 - truth.xi0, np.nan)
    return {
        "psi": psi,
        "size": size,
        "xi0": xi0,
        "psi_rms": rmsd(psi[inside]),
        "size_rms": rmsd(size[inside]),
        "xi0_rms": rmsd(xi0),
    }


def draw(titles: list[str], maps: list[dict[str, Any]]) -> Any:
    """Errors of psi, |D| and xi0, before above after, on the same scales."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    figure.suptitle("SIMULATED sphere, 662 nm, Omega 35: error of the model and of the Stokes camera's xi0")
    axes = figure.subplots(2, 3)
    wide = {"psi": 90.0, "size": 60.0, "xi0": 0.06}
    units = {"psi": "psi / degree", "size": "|D| / %", "xi0": "xi0"}
    for row, (title, found) in enumerate(zip(titles, maps, strict=True)):
        for axis, key in zip(axes[row], wide, strict=True):
            image: Array = found[key]
            drawn_image = axis.imshow(image, vmin=-wide[key], vmax=wide[key], cmap="RdBu_r")
            axis.set_title(f"{units[key]}: {title}, rms {found[key + '_rms']:.3g}", fontsize=8)
            axis.set_axis_off()
            figure.colorbar(drawn_image, ax=axis, shrink=0.8)
    return figure


if __name__ == "__main__":
    main()
