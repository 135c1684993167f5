"""Take a capture on the simulated rig and look at its Mueller matrix: drivers, emulators, file, reduction.

Run: .venv/bin/python examples/take_a_capture.py [FOLDER]
"""

import sys

from acquisition import DEFAULT_RIG, MeasurementPlan, load_rig, take_capture
from processing import reduce_to_dataset

folder = sys.argv[1] if len(sys.argv) > 1 else "captures"
capture = take_capture(MeasurementPlan(omega_deg=35, wavelength_nm=662), load_rig(DEFAULT_RIG), folder)
image = reduce_to_dataset(capture)
middle = {"y": image.sizes["y"] // 2, "x": image.sizes["x"] // 2}
print(capture)
print((image.mueller / image.mueller[0, 0]).isel(middle).values.round(3))
print("median reduced chi square", round(image.attrs["median_reduced_chi_square"], 3))
