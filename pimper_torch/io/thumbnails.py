"""Thumbnails of 8x8 grey levels, by which a result recognizes its photographs."""

import re
from collections.abc import Mapping

import torch
from torch.nn.functional import adaptive_avg_pool2d

from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.mapped import each

_SIDE = 8
_WRITTEN = re.compile(f"[0-9a-f]{{{2 * _SIDE**2}}}")
# Root mean square difference, in levels of 255. The demo's photographs differ by at most 0.7 from
# their versions as PNG, JPEG of quality 50 or half the size, and by at least 11 from each other.
_SAME = 2.0


def thumbnails(views: Views) -> dict[str, str]:
    """Return the thumbnail of each photograph: 8x8 grey levels in 8-bit sRGB, in hexadecimal.

    Averages are of linear radiance, which resizing and conversion of the format do not change.
    """
    digits = {}
    sizes = views.sizes_px.tolist()
    for name, (image,), (width, height) in zip(views.names, each(views.images), sizes, strict=True):
        grey = image[:, :height, :width].detach().mean(dim=0, keepdim=True)
        digits[name] = bytes(to_bytes(adaptive_avg_pool2d(grey, _SIDE)).flatten().tolist()).hex()
    return digits


def compare_thumbnails(views: Views, known: Mapping[str, str], where: str) -> None:
    """Raise an error if names of photographs were exchanged, and warn if photographs changed.

    Args:
        views: Current photographs.
        known: Result of :func:`thumbnails` for the previous photographs.
        where: Subject of the messages: the photographs.

    Raises:
        InputError: A photograph differs from its thumbnail, and matches that of a different name.
    """
    now = thumbnails(views)
    names = [name for name in now if _WRITTEN.fullmatch(str(known.get(name)))]
    if not names:
        return
    levels, before = (
        torch.tensor([list(bytes.fromhex(digits[name])) for name in names]).double()
        for digits in (now, known)
    )
    differences = torch.cdist(levels, before) / _SIDE
    nearest, match = differences.min(dim=1)
    same_name = differences.diagonal()
    changed = [(row, name) for row, name in enumerate(names) if float(same_name[row]) > _SAME]
    renamed = [f"{name} is {names[match[row]]}" for row, name in changed if nearest[row] <= _SAME]
    if renamed:
        raise InputError(
            f"{where} were renamed: {some(renamed)}; needed: the names of the run. Give the folder "
            "of the originals with `--photos DIR` (`photographs=`)."
        )
    if changed:
        caution(
            f"{where} have changed: {some([name for _, name in changed])}. They are written as "
            "they are. Give the folder of the originals with `--photos DIR` (`photographs=`).",
            stacklevel=4,
        )
