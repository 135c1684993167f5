"""A capture straight from the simulated bench, without drivers: seconds, for trying things out.

Run: .venv/bin/python examples/from_simulated_bench.py [FOLDER]
"""

import sys
from pathlib import Path

from acquisition import CONFIGS, Scene, SimulatedBench, write_virtual_capture
from processing import InstrumentModel, Reduction, Xi0, open_dataset

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
instrument = InstrumentModel.load(CONFIGS / "instruments/rgb950.yaml")
scene = Scene.load(CONFIGS / "scenes/red_sphere.yaml")
bench = SimulatedBench(scene, instrument.at(662), 662, rows=100, columns=100, flux_e_per_s=8e5, seed=1)
write_virtual_capture(folder / "sphere.h5", bench, instrument, omega_deg=35)
mueller = Reduction(folder / "sphere.h5").make(overwrite=True)
xi0 = open_dataset(Xi0(mueller).make(overwrite=True))
print("median xi0 of what is valid:", float(xi0.xi0.where(xi0.valid > 0).median()))
