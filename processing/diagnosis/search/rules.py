"""Constants by which the diagnosis decides, shared by instrument and surface; each with its unit and its reason."""

from __future__ import annotations

import numpy as np

#: Sine of the angle between two signatures from which on a capture tells them apart.
APART = 0.3

# ---- prior: what is plausible before the data are seen -------------------------------------------------------------
#: Standard deviations of the values of a group, in typical sizes, and how plausible each is. Mounts are set to a
#: fraction of a degree far more often than they are left wrong by three typical sizes.
TAU = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
TAU_WEIGHT = np.array([0.1, 0.2, 0.3, 0.3, 0.1])
#: Weight of the prior for few causes: with k of n groups there, one more has odds of (1 + k) to ((1 + this) n - k - 1).
#: A clean bench has few causes, one with six faults may well have a seventh.
FEW_CAUSES = 0.5
#: Standard deviation of a nominal value of the train, in typical sizes (30 degrees): the weakest prior that keeps it.
NOMINAL_TAU = 10.0

# ---- noise ---------------------------------------------------------------------------------------------------------
#: Standard deviations of the noise's own chi-square up to which a total excess is no structure.
SLACK = 2.0
#: Least residual, relative to the signal, that is taken as noise where the noise is not known: no bench repeats better.
LEAST_NOISE = 1e-4

#: Log odds of the scatter of the counts against the noise that a correction of them tells, from which on it is dropped.
REFUTED = 12.0

# ---- search --------------------------------------------------------------------------------------------------------
#: Times that the problem is linearized anew about its solution.
ROUNDS = 7
#: A move, in standard deviations of the posterior, below which no new linearization is needed.
SETTLED = 0.3
#: Sets that are visited in the last round, and in those before.
SAMPLES, SAMPLES_BEFORE = 300, 80
#: Probability from which on a group takes part when the solution is improved, and in the correction that is written.
#: What is less likely moves the mean by less than its own error.
TAKES_PART = 0.25

#: Share of benches on which an effect is there at its typical size, for what the data say nothing of: a bench that is
#: new has a third of the list.
UNSEEN = 0.3

#: Probability from which on a member of a class that is likely as a whole takes its share in the correction.
SHARES = 0.01

# ---- wiring --------------------------------------------------------------------------------------------------------
#: Factor by which less must be left over without a mistake of wiring (tests/physics/test_diagnosis_wiring.py).
WIRING = 5.0

# ---- names ---------------------------------------------------------------------------------------------------------
#: Probabilities from which on a cause is called sure, and likely.
SURE, LIKELY = 0.99, 0.9
#: Most that is told of a cause that may be a part of what is left unexplained.
DOUBTED = 0.95
#: Log odds by which an alternative may be worse in a cause's place and still be named with it: 1 to 1100.
ALTERNATIVE = 7.0
#: The same as a share of what the cause explains: no effect's model is exact.
ALIKE = 1e-3
#: Standard deviations by which an effect of typical size has to stand out for its absence to mean anything.
VISIBLE_FAULT = 4.0
#: Gain in chi-square from which on something that needs a search of its own (a retardance that varies over the image,
#: clipped pixels, a far start) is looked into.
DECISIVE = 25.0
