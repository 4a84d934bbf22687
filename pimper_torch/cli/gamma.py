"""``pimper gamma``: the response of photographs from a fixed camera under several lights."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from pimper_torch.cli.bars import Bars
from pimper_torch.datasets.raster import read_mask
from pimper_torch.errors import InputError
from pimper_torch.io.photographs import load_views
from pimper_torch.photometry.gamma import GammaEstimate, gamma_of_photographs
from pimper_torch.progress import listening
from pimper_torch.radiometry import LINEAR

# Residuals so near the best one are as good.
_AS_GOOD = 1.05


def run(command: str, arguments: Sequence[str]) -> None:
    """Carry out ``gamma``: read, estimate, and say what to tell `pimper reconstruct`.

    Raises:
        PimperError: Photographs that cannot be read, or too few under too few lights.
    """

    def gamma(
        photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")],
        mask: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
        rank: Literal[3, 4] = 4,
        max_size_px: int = 0,
    ) -> None:
        """Find the gamma of photographs that a fixed camera took of one object under many lights.

        Args:
            photos: Folder of JPEG, PNG or TIFF files; the camera did not move.
            mask: Image that is bright on the object and dark off it, of the photographs' size.
            rank: 3 if lamps are far away and the room is dark, 4 with ambient light.
            max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
        """
        if mask is not None and not mask.is_file():
            raise InputError(
                f"{mask}: there is no such file; needed: a mask, bright on the object, for all "
                "photographs."
            )
        with Bars(Console(stderr=True)) as bars:
            bars.started("read")
            with listening(bars.progressed):
                views = load_views(photos, encoding=LINEAR, max_size_px=max_size_px)
        drawn = None if mask is None else read_mask(mask, max_size_px)
        found = gamma_of_photographs(views, mask=drawn, rank=rank)
        Console().print(f"{found}{advice(found)}", highlight=False, soft_wrap=True, markup=False)

    tyro.cli(gamma, prog=f"pimper {command}", args=list(arguments))


def advice(found: GammaEstimate) -> str:
    """Say which response to tell `pimper reconstruct`; nothing if none is known."""
    if not found.determined:
        return ""
    response = f"{found.gamma:.2f}"
    if found.residual_linear <= _AS_GOOD * found.residual:
        response = "linear"
    elif found.residual_srgb <= _AS_GOOD * found.residual:
        response = "srgb"
    return f"\n  pimper reconstruct PHOTOS -o RESULT --photographs.response {response}"
