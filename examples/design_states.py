"""Score the lab's table of states and find a better one for the same plates.

Run: .venv/bin/python examples/design_states.py
"""

import numpy as np

from acquisition import CONFIGS
from processing import InstrumentModel, free_design, rotating_retarders

model = InstrumentModel.load(CONFIGS / "instruments/rgb950.yaml").at(662)
w = model.rows(rotating_retarders(0.02).angles_deg).reshape(-1, 16)
print(f"the lab's table: equally weighted variance {np.trace(np.linalg.inv(w.T @ w)):.2f}")
best = free_design(model, 40)
print(f"free angles:     {best.variance:.2f}; the bound for any plates is {best.bound:.0f}")
