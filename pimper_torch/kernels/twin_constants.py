"""Constants shared by kernels of the photometry and their twins in torch."""

# Codes of the losses.
SQUARES, CAUCHY, GEMAN_MCCLURE, HUBER = range(4)

# Their scales in standard deviations, for 95 % efficiency on Gaussian noise (Holland & Welsch,
# 1977, for the first and the last; checked in `test_robust.py`).
CAUCHY_TUNING, GEMAN_MCCLURE_TUNING, HUBER_TUNING = 2.385, 3.787, 1.345

# The M-estimate of scale of unit Gaussian noise: the root of its equation's expectation, checked in
# `test_robust.py`.
GAUSSIAN_SCALE = 0.6472404

# Maximum number of its Newton steps, and their maximum length in the logarithm of the squared
# scale: a choice; from the mean square, few outliers need more than ten.
NEWTON_STEPS, LONGEST_NEWTON_STEP = 40, 1.5

# Lower bound of the residuals' standard deviation, as a fraction of brightness: residuals of exact
# data are rounding, without outliers. A choice.
MIN_DEVIATION = 1e-4

# Longest step along a curved manifold, as a fraction of albedo (about radians of the normal): a
# choice, because the quadratic model is valid only nearby.
MAX_STEP = 0.3

# Initial damping, as a fraction of the mean curvature, and the factors of its decrease and
# increase. Of initial values from 1e-4 to 1e-2 and factors from 3 to 10 these led most random
# starts to the best known minimum (9 of 10 on dino_trimmed; 10 and 1e-3 led 5 there).
INITIAL_DAMPING = 1e-2
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 5.0

# Gauss-Newton steps of the shading vectors after each step of the lights: a choice.
SHADING_STEPS = 2

# Residuals below this many roundings of the data are treated as zero: a choice.
ZERO_ROUNDINGS = 30.0
