"""Conventions of guessed maps, and how far off they are where nothing says it."""

from typing import Literal

# Root mean squares that published estimators are off indoors. DSINE (CVPR 2024) has a mean of 16
# degrees on NYUv2; Marigold (CVPR 2024) one of 5.5 % of depth once factor and offset are fitted.
# Large errors are many.
NORMALS_ERROR_DEG, DEPTH_ERROR = 25.0, 0.08

NormalAxes = Literal["auto", "opencv", "opengl", "lub", "dsine", "world"]
