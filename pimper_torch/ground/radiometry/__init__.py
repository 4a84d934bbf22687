"""Radiance and the encoded values that files hold: responses, saturation, sRGB."""

from pimper_torch.ground.radiometry.encoding import FROM_FILES, LINEAR, SRGB, Encoding
from pimper_torch.ground.radiometry.response import (
    Curve,
    Gamma,
    Linear,
    Response,
    Srgb,
    linear_from_srgb,
    srgb_from_linear,
    to_bytes,
)
from pimper_torch.ground.radiometry.saturation import SATURATED, find_saturation

__all__ = [
    "FROM_FILES",
    "LINEAR",
    "SATURATED",
    "SRGB",
    "Curve",
    "Encoding",
    "Gamma",
    "Linear",
    "Response",
    "Srgb",
    "find_saturation",
    "linear_from_srgb",
    "srgb_from_linear",
    "to_bytes",
]
