"""A bench does something that its instrument file does not say; `diagnose` finds it, and the Mueller image improves.

Run: .venv/bin/python examples/close_the_loop.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

from acquisition import CONFIGS, Scene, SimulatedBench, write_virtual_capture
from processing import InstrumentModel, diagnose_captures, reduce_to_dataset, write_instrument
from simulators.bench.effects.motion import AngleOffset

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
instrument = InstrumentModel.load(CONFIGS / "instruments/rgb950.yaml")
scene = Scene.load(CONFIGS / "scenes/red_sphere.yaml")
undeclared = (AngleOffset(axis="psg", offset_deg=0.5),)
bench = SimulatedBench(
    scene, instrument.at(662), 662, rows=100, columns=100, flux_e_per_s=8e5, seed=2, effects=undeclared
)
write_virtual_capture(folder / "bent.h5", bench, instrument, omega_deg=35)

judged, _ = diagnose_captures([folder / "bent.h5"], instrument)
print(judged.diagnosis.verdict)
for effect in judged.diagnosis.effects:
    print(effect.kind, {name: entry.text for name, entry in effect.parameters.items()})
write_instrument(folder / "corrected.yaml", instrument, judged.diagnosis)

truth = np.moveaxis(np.asarray(scene.mueller_image(35, 662, 100, 100)), (2, 3), (0, 1))
for name, file in (("declared", None), ("corrected", folder / "corrected.yaml")):
    image = reduce_to_dataset(folder / "bent.h5", file)
    lit = image.mueller.values[0, 0] > 50 * image.mueller_errors.values[0, 0]
    found, true = image.mueller.values[:, :, lit], truth[:, :, lit]
    wrong = np.median(found / found[0, 0] - true / true[0, 0], axis=-1)
    print(f"{name}: rms of the median errors of m_ij / m00 {np.sqrt(np.mean(wrong**2)):.4f}")
