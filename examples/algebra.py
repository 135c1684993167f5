"""Mueller matrices, their coherency eigenvalues and their decomposition, without any file.

Run: .venv/bin/python examples/algebra.py
"""

import numpy as np

from processing import cloude, xi0_and_dominant
from processing.polarization import mueller

retarder = mueller.retarder(np.deg2rad(30), np.deg2rad(127))
depolarized = 0.7 * retarder + 0.3 * mueller.IDEAL_DEPOLARIZER
xi0, dominant = xi0_and_dominant(depolarized)
print("eigenvalues", cloude(depolarized).eigenvalues.round(3))
print("xi0", float(xi0).__round__(4), "and its process is the retarder:", np.allclose(dominant, retarder))
