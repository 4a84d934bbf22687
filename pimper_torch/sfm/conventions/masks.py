"""Masks that show the object dark, and those drawn on the pixels that files store.

A program that does not know EXIF shows, and draws on, the pixels as the file has them. Sizes tell
that of a quarter turn; of a half turn, and of square photographs, outlines do: a mask that lies
right ends where the photograph changes.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from pimper_torch.errors import caution
from pimper_torch.mapped import each
from pimper_torch.sfm.conventions.choice import ERRORS

_APART = 8  # pixels along an outline that are told apart: a choice
# Masks are turned round where more than the rest of it is bright at the border, and less inside.
_TELLING = 0.25


def object_is_dark(opacities: Sequence[Float[Tensor, "_ _"]], where: str) -> bool:
    """Return whether masks show the object dark, by all of them together; a warning says so."""
    border, centre = [], []
    for (opacity,) in each(opacities):
        high, wide = opacity.shape
        border += [opacity[0].mean(), opacity[-1].mean(), opacity[:, 0].mean()]
        border.append(opacity[:, -1].mean())
        inner = opacity[high // 4 : -(-3 * high // 4), wide // 4 : -(-3 * wide // 4)]
        centre.append(inner.mean())
    fractions = float(torch.stack(border).mean()), float(torch.stack(centre).mean())
    # An object that fills its photographs is bright in the centre, too.
    dark = fractions[0] > 1 - _TELLING and fractions[1] < 1 - _TELLING
    if dark:
        caution(
            f"{where}: the masks are bright along {fractions[0]:.0%} of the border and "
            f"{fractions[1]:.0%} of the centre, so the object is taken to be dark in them. "
            "`--mask-object bright` says that it is not.",
            stacklevel=4,
        )
    return dark


def drawn_as_stored(
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
    pairs = zip(ways, pictures, strict=True)
    both = [(*masks, one) for masks, one in pairs if len(masks) == 2 and not torch.equal(*masks)]
    if not both:
        return False
    plain, turned = (torch.cat([_changes(one[way], one[2]) for one in both]) for way in range(2))
    errors = 0.0
    if min(len(plain), len(turned)) >= 2 * _APART:
        variance = _APART * (plain.var() / len(plain) + turned.var() / len(turned))
        errors = float((turned.mean() - plain.mean()) / variance.sqrt().clamp_min(1e-12))
    told = f"{len(both)} of {len(ways)} masks, whose photographs EXIF turns"
    if errors > ERRORS:
        caution(
            f"{where}: {told}, are drawn on the pixels that the files store, as their outlines "
            "show; they are turned, too.",
            stacklevel=4,
        )
    elif errors > -ERRORS:
        caution(
            f"{where}: of {told}, nothing tells whether they are turned already; they are taken as "
            "they are. If that is wrong, turn them.",
            stacklevel=4,
        )
    return errors > ERRORS


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
