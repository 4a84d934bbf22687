"""Encoding of radiance that a file declares."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.radiometry.response import Curve, Gamma, Linear, Response, Srgb
from pimper_torch.records.shapes import Matrix3

_LEVELS = torch.linspace(0, 1, 1025, dtype=torch.float64, device="cpu")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Colour:
    """Encoding that a file declares.

    Attributes:
        source: Declaration, such as ``ICC profile "Display P3"``; empty without one.
        response: ``None`` if it is not declared or not supported.
        srgb_from_file: From linear values to linear sRGB; ``None`` if the primaries are those of
            sRGB, or not declared.
        trouble: Unsupported part of the declaration; empty if all is supported.
    """

    source: str = ""
    response: Response | None = None
    srgb_from_file: Matrix3 | None = None
    trouble: str = ""


SILENT = Colour()


def plain(response: Response) -> Response:
    """Return ``Linear`` or ``Srgb`` if ``response`` equals it in 8 bits, else ``response``."""
    standards: tuple[Response, ...] = (Linear(), Srgb())
    for standard in standards:
        encoded = standard.encoded_from_linear(_linear_levels(response))
        # In a file of 8 bits, differences of up to half a level of 255 vanish.
        if float((encoded - _LEVELS).abs().max()) <= 0.5 / 255:
            return standard
    return response


def disagree(one: Response, other: Response) -> bool:
    """Return whether radiance differs by over 0.02 of full scale; gamma 2.2 and sRGB agree."""
    return float((_linear_levels(one) - _linear_levels(other)).abs().max()) > 0.02


def describe(response: Response) -> str:
    """Return the name of a response, as in the option."""
    if isinstance(response, Linear):
        return "linear"
    if isinstance(response, Srgb):
        return "srgb"
    return f"{response.exponent:.4g}" if isinstance(response, Gamma) else "a curve"


def _linear_levels(response: Response) -> Float[Tensor, "channel level"]:
    rows = len(response.radiance) if isinstance(response, Curve) else 1
    return response.linear_from_encoded(_LEVELS.expand(rows, 1, -1))[:, 0]
