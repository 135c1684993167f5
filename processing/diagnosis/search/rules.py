"""Constants by which the diagnosis decides, shared by instrument and surface; each with its unit and its reason.

`./lab ablate` halves and doubles each of them on benches with many faults and prints what changes.
"""

from __future__ import annotations

import numpy as np

# ---- prior: what is plausible before the data are seen -------------------------------------------------------------
#: [typical sizes] Beyond which a value is far: mounts are set to a fraction of a degree far more often.
FAR = 3.0
#: [typical sizes] Standard deviations of the values of a group; the last two only of a train that may be far off.
TAU = np.array([0.03, 0.055, 0.1, 0.17, 0.3, 0.55, 1.0, 1.7, FAR, 10.0, 30.0])
#: [probability] How plausible each of these standard deviations is, for a few values: every second is enough.
TAU_WEIGHT = np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0, 0.3, 0.0, 0.1, 0.0, 0.0])
#: [probability] The same for a value of each state: forty tell theirs so well that with every second two groups of a
#: third each would do better than the one that is there.
TAU_WEIGHT_OF_MANY = np.array([0.04, 0.08, 0.1, 0.13, 0.16, 0.16, 0.16, 0.1, 0.07, 0.0, 0.0])
#: [probability] The same for a value of a train that may be far off.
TAU_WEIGHT_OF_FAR = np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0, 0.2, 0.0, 0.1, 0.05, 0.05])
#: [1] Values from which on a group has many: it can do what several others do.
MANY = 9
#: [typical sizes] Standard deviation of a nominal value of the train (30 degrees): the weakest prior that keeps it.
NOMINAL_TAU = 10.0
#: [degree] Typical size of a nominal azimuth or retardance: what is read off a mount or a label is no better.
NOMINAL_DEG = 30.0
#: [degree] The same of the retardance of what has none: a window is close to that.
WINDOW_DEG = 1.0
#: [1] The same of an extinction, as what is only nominal may be a film, and of the gain of a channel: coatings and two
#: cameras differ by this much.
NOMINAL_PART = 0.1
#: [1] The same of a diattenuation, of a depolarization, and of the change of a level from state to state. As far below
#: zero may noise take an extinction or a depolarization.
NOMINAL_SHARE = 0.01
#: [of a factor e in wavelength] Length over which values of optics stay alike from one wavelength to another: an
#: achromatic plate bends once over an octave, a coating a few times.
SMOOTH = 0.3

# ---- noise ---------------------------------------------------------------------------------------------------------
#: [standard deviations] Total excess over the noise's own chi-square up to which it is no structure; of information
#: about a typical size below which an effect cannot be seen.
SLACK = 2.0
#: [of its variance] Standard error of the noise itself: no gain is known better than to half a percent. Of two million
#: intensities that is five times what chance does to their sum of squares.
NOISE_LEVEL = 0.005
#: [of the signal] Least residual that is taken as noise where the noise is not known: no bench repeats better. An
#: effect of less is not seen, and single precision is enough for more.
LEAST_NOISE = 1e-4


# ---- what is left out of a capture ---------------------------------------------------------------------------------
#: [pixels, pairs] Below which nothing can stand out, neighbours are not compared, and an object tells nothing.
FEWEST_OF_MANY = 100
#: [pixels] That tell a scatter, or its directions, to half a percent: more need not be looked at.
ENOUGH_PX = 50_000
#: [of the residual] That a bad frame, a far start or a round of a search has to take away.
MOSTLY = 0.5
#: [of its pixels] That are cut off, or struck, in a state: beyond, the state itself is no measurement.
MOST_SPOILT = 0.01
#: [directions] Over the states that the model leaves over, below which they tell no hits and no noise.
FEWEST_FREE = 4

# ---- the detector's noise, as its images show it ------------------------------------------------------------------
#: [1] Deviation of the variance of a pixel from what is declared that is told: four standard deviations of what labs
#: know of a gain by photon transfer curves. A bend of the response that needs half of it does not go with the counts.
NOISE_OFF = 0.06
#: [1] The same of the part of the variance without light: darks of a lab are as good.
DARK_NOISE_OFF = 0.5
#: [of the whole] Below which a part tells nothing: of the variance with or without light, of the scatter of a row, of
#: the light in dim pixels, of the noise in image derivatives, of the noise that neighbours share.
SMALL = 0.05
#: [of the whole] A part that changes nothing: weak beliefs, first damping, least width of a prior, least part of a
#: variance, and how much worse another branch of the train may fit.
LITTLE = 1e-3

# ---- search --------------------------------------------------------------------------------------------------------
#: [of the signal] Residual above which nominal values are searched for from many starts.
FAR_OFF = 0.05
#: [unit of chi-square] After the first choice of groups, from which on the first linearization is not believed.
BENT = 2.0
#: [log odds] At which evidence decides by itself, 1 to 160 000: a group is not taken away any more, a correction is
#: dropped that the scatter of the counts contradicts, and something that needs a search of its own is looked into.
NEEDED = 12.0
#: [1] Growth of the unit of chi-square, by what the tests of the residual find, from which on the sets are visited
#: again; and at values beyond what a straight line to them promised, from which on it is not believed.
GROWTH = 1.05
#: [typical sizes, or standard deviations] Up to which a straight line is exact enough: from where counts were corrected
#: exactly, or where the problem was linearized.
EXACT = 0.3

# ---- correction ----------------------------------------------------------------------------------------------------
#: [probability] From which on a group takes part in the correction that is written. What is less likely moves the mean
#: by less than its own error.
TAKES_PART = 0.25
#: [unit of chi-square] That a correction may lose against the posterior mean. With less, the file holds effects without
#: weight; with more, M departs from that of the mean.
MISSED = 3.0
#: [1] Growth of the residual on held-out data that is still put down to chance.
WORSE = 1.002
#: [probability] That the error of what the user reads grows by a correction, up to which it is written: below it the
#: expected error falls.
CHANCE_WORSE = 0.5
#: [of m00] Least change of M/m00 that is asked for its error: less is the rounding of counts.
LEAST_CHANGE = 2e-5

# ---- structure -----------------------------------------------------------------------------------------------------
#: [standard deviations] From which on something stands out: structure of a residual, the noise from what is declared,
#: a pixel from the dark, an effect of typical size, a mistake of wiring. Residuals are cut back there.
LIMIT = 5.0
#: [pixels] Below which means over them tell no noise, no black level and no pattern.
FEWEST_PIXELS = 30

# ---- what is held out, and parts of an image ------------------------------------------------------------------------
#: [tiles] Along a side of a small image, of an object, and of the patches whose means are tested.
TILES = 8
#: [parts] That are held out in turn, of the tiles, as a chessboard has them.
FOLDS_OF_TILES = 2

# ---- names ---------------------------------------------------------------------------------------------------------
#: [probability] From which on a cause is called sure.
SURE = 0.99
#: [probability] From which on a cause is called likely.
LIKELY = 0.9
#: [log odds] By which another group, or set, may be worse and still be tried, 1 to 1100: the unit of chi-square may
#: fall with it.
ALTERNATIVE = 7.0
#: [standard deviations] From which on a value is not zero; of several as many beyond what chance gives all of them.
SHOWN = 3.0
#: [causes] That are told with what each would explain alone; half of them as tried where nothing is named.
MOST_RANKED = 10

# ---- why a name is doubted -----------------------------------------------------------------------------------------
#: [of a shift, and of what is left at the edges] What sharp edges, which no fit saw, must show of an image that is said
#: to move. Where it does they show 0.5 to 1.1 of it, and it explains 0.5 to 0.7 of what they do; of light that is
#: added, or a spot that fades, one of the two is 0 to 0.4.
EDGES = 0.43
#: [of the directions of the data] What values for each state, with all others, may have.
TESTABLE = 0.75
#: [1] With structure left something is there that is not in the list, and causes that are may be parts of it: one alone
#: has to explain this many times what is left, the second strongest four times as much, the third nine times, ...
TIMES = 100.0

# ---- what captures can show ----------------------------------------------------------------------------------------
#: [sine] Of the angle between two signatures, from which on a capture tells them apart.
APART = 0.3

# ---- effort: what a search may cost --------------------------------------------------------------------------------
#: [typical sizes] Step of a derivative.
STEP = 1e-4
#: [rounds] Times that the problem is linearized anew about its solution.
ROUNDS = 7
#: [answers] That are kept: a step is asked again and again, and frames that moved together share one.
KEPT = 1024
#: [changes] Of a chain in the last round.
CHANGES = 300
#: [changes] The same in the rounds before.
CHANGES_BEFORE = 30
