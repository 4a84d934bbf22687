"""Encoding of radiance by a file's samples."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.radiometry.response import Curve, Gamma, Linear, Response, Srgb
from pimper_torch.ground.shapes import Matrix3

_LEVELS = torch.linspace(0, 1, 1025, dtype=torch.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Colour:
    """Encoding of a file's samples.

    Attributes:
        source: Where it says so, such as ``ICC profile "Display P3"``; empty where it is silent.
        response: ``None`` where it says nothing, or nothing that can be followed.
        srgb_from_file: From linear values to linear sRGB; ``None`` where primaries are those of
            sRGB, or not told.
        trouble: What about it cannot be followed; empty where all can.
    """

    source: str = ""
    response: Response | None = None
    srgb_from_file: Matrix3 | None = None
    trouble: str = ""


SILENT = Colour()


def plain(response: Response) -> Response:
    """Return the standard response that a file's own cannot be told from, or the file's own."""
    known: tuple[Response, ...] = (Linear(), Srgb())
    for standard in known:
        again = standard.encoded_from_linear(_through(response))
        # Half a level of 255 is what no file of 8 bits tells from the curve itself.
        if float((again - _LEVELS).abs().max()) <= 0.5 / 255:
            return standard
    return response


def disagree(one: Response, other: Response) -> bool:
    """Return whether radiance differs by 0.02 of full scale; of gamma 2.2 and sRGB it does not."""
    return float((_through(one) - _through(other)).abs().max()) > 0.02


def describe(response: Response) -> str:
    """Name a response as the option does."""
    if isinstance(response, Linear):
        return "linear"
    if isinstance(response, Srgb):
        return "srgb"
    return f"{response.exponent:.4g}" if isinstance(response, Gamma) else "a curve"


def _through(response: Response) -> Float[Tensor, "channel level"]:
    rows = len(response.radiance) if isinstance(response, Curve) else 1
    spread = _LEVELS.expand(rows, 1, -1)
    return response.linear_from_encoded(spread)[:, 0]
