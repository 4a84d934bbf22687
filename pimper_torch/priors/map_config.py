"""Conventions of maps of networks, and their default errors."""

from typing import Literal

# Root mean square errors of published networks indoors. Mean errors are 16 degrees for DSINE (CVPR
# 2024) on NYUv2, and 5.5 % of depth for Marigold (CVPR 2024) after fitting factor and offset; large
# errors are frequent.
NORMALS_ERROR_DEG, DEPTH_ERROR = 25.0, 0.08

NormalAxes = Literal["auto", "opencv", "opengl", "lub", "dsine", "world"]
