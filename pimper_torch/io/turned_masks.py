"""Masks drawn on the pixels that files store, beside photographs that EXIF turns.

A program that does not know EXIF shows, and draws on, the pixels as the file has them. Sizes tell
that of a quarter turn; of a half turn, and of square photographs, outlines do: a mask that lies
right ends where the photograph changes.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from pimper_torch.errors import InputError, caution
from pimper_torch.io.decode import rotated
from pimper_torch.io.header import Header

# Standard errors by which the photographs must change more along the outlines of one way; pixels
# along an outline that are told apart: choices.
_ERRORS, _APART = 4.0, 8
Mask = Float[Tensor, "_ _"]


def mask_ways(
    drawn: Mask, path: Path | str, found: Header, photograph: Path | str, header: Header
) -> list[Mask]:
    """Return the ways in which a mask may lie on its photograph: as it is, or turned by EXIF.

    Args:
        drawn: As the mask's file has it, turned by an EXIF of its own.
    """
    ways = [drawn]
    if header.orientation != 1 and found.orientation == 1:
        ways.append(torch.from_numpy(rotated(drawn.numpy(), header.orientation)))
    fitting = [way for way in ways if way.shape == (header.height, header.width)]
    if fitting:
        return fitting
    raise InputError(
        f"{path}: is {drawn.shape[1]} x {drawn.shape[0]}, but the photograph "
        f"{Path(photograph).name} is {header.width} x {header.height}; needed: a mask of the same "
        "size."
    )


def choose_ways(
    ways: Sequence[tuple[Bool[Tensor, "_ _"], ...]],
    pictures: Sequence[Float[Tensor, "channel _ _"]],
    where: str,
) -> bool:
    """Return whether masks that may lie either way are drawn on the pixels that files store.

    All of them together, as one program drew them. A warning says where they are, and where
    nothing tells.

    Args:
        ways: Of every mask; of two, the first as it is.
    """
    open_ones = [
        (masks, picture)
        for masks, picture in zip(ways, pictures, strict=True)
        if len(masks) == 2 and not torch.equal(*masks)
    ]
    if not open_ones:
        return False
    plain, turned = (
        torch.cat([_changes(masks[way], picture) for masks, picture in open_ones])
        for way in range(2)
    )
    errors = 0.0
    if min(len(plain), len(turned)) >= 2 * _APART:
        variance = _APART * (plain.var() / len(plain) + turned.var() / len(turned))
        errors = float((turned.mean() - plain.mean()) / variance.sqrt().clamp_min(1e-12))
    told = f"{len(open_ones)} of {len(ways)} masks, whose photographs EXIF turns"
    if errors > _ERRORS:
        caution(
            f"{where}: {told}, are drawn on the pixels that the files store, as their outlines "
            "show; they are turned, too.",
            stacklevel=4,
        )
    elif errors > -_ERRORS:
        caution(
            f"{where}: of {told}, nothing tells whether they are turned already; they are taken as "
            "they are. If that is wrong, turn them.",
            stacklevel=4,
        )
    return errors > _ERRORS


def _changes(
    mask: Bool[Tensor, "height width"], picture: Float[Tensor, "channel height width"]
) -> Float[Tensor, " pixel"]:
    """Return how much a photograph changes at each pixel of an outline, as part of its mean."""
    level = picture.mean(dim=0).clamp_min(0).sqrt()
    down, right = torch.gradient(level)
    change = torch.hypot(down, right)
    opaque = mask.to(level)[None]
    inner = -max_pool2d(-opaque, 3, stride=1, padding=1)
    outline = (max_pool2d(opaque, 3, stride=1, padding=1) > inner)[0]
    return change[outline] / change.mean().clamp_min(1e-12)
