"""Constants that a kernel of the photometry and its twin in torch have in common."""

# Codes of the losses.
SQUARES, CAUCHY, GEMAN_MCCLURE, HUBER = range(4)

# Their scales in standard deviations, at which they are 95 % efficient on Gaussian noise (Holland &
# Welsch, 1977, of the first and the last; checked in `test_robust.py`).
CAUCHY_TUNING, GEMAN_MCCLURE_TUNING, HUBER_TUNING = 2.385, 3.787, 1.345

# The M-estimate of scale of unit Gaussian noise: the root of its equation's expectation, checked in
# `test_robust.py`.
GAUSSIAN_SCALE = 0.6472404

# Its Newton's steps at most, and their longest, in logarithms of the squared scale: a choice;
# started at the mean square, few outliers need more than ten.
NEWTON_STEPS, LONGEST_NEWTON_STEP = 40, 1.5

# Lower bound of the residuals' standard deviation, as a fraction of brightness: on exact data all
# residuals are rounding, and none is an outlier. A choice.
MIN_DEVIATION = 1e-4

# Longest step along a curved manifold, as a fraction of albedo (about radians of the normal): a
# choice, for the quadratic model holds nearby only.
MAX_STEP = 0.3

# Initial damping, as a fraction of the mean curvature, and the factors by which it falls and
# rises. Of initial values from 1e-4 to 1e-2 and factors from 3 to 10 these led most random starts
# to the best minimum known (9 of 10 on dino_trimmed; 10 and 1e-3 led 5 there).
INITIAL_DAMPING = 1e-2
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 5.0

# Gauss-Newton steps of the shading vectors after each step of the lights: a choice.
SHADING_STEPS = 2

# Residuals below this many roundings of the data count as zero: a choice.
ZERO_ROUNDINGS = 30.0
