"""When Levenberg-Marquardt ends, for its array form and its compiled form alike."""

MAX_ITERATIONS = 60
# A step that would move the whitened residuals by less than this (their 2-norm) is the last one;
# so is one after which, as steps shrink, the next would be that small beside the residuals.
STEP_TOLERANCE = 2e-9
ROUNDING = 1e-13
# Whitened residuals are known to no better than this: image points of 1000 px have 13 digits.
NOISE = 1e-11
STUCK = 1e12
