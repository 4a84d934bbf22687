"""Photographs in 64 grey levels each, by which a result knows them again."""

import re
from collections.abc import Mapping

import torch
from torch.nn.functional import adaptive_avg_pool2d

from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.mapped import each

_SIDE = 8
_WRITTEN = re.compile(f"[0-9a-f]{{{2 * _SIDE**2}}}")
# Root mean square, in levels of 255. The demo's photographs differ from themselves by 0.7 at most
# as PNG, as JPEG of quality 50 or at half the size, and from one another by 11 at least.
_SAME = 2.0


def thumbnails(views: Views) -> dict[str, str]:
    """Average each photograph over 8x8 fields: grey levels in 8-bit sRGB, two digits each.

    Averages are of linear radiance, which neither a resize nor another format changes.
    """
    found = {}
    sizes = views.sizes_px.tolist()
    for name, (image,), (width, height) in zip(views.names, each(views.images), sizes, strict=True):
        grey = image[:, :height, :width].detach().mean(dim=0, keepdim=True)
        found[name] = bytes(to_bytes(adaptive_avg_pool2d(grey, _SIDE)).flatten().tolist()).hex()
    return found


def compare_thumbnails(views: Views, known: Mapping[str, str], where: str) -> None:
    """Refuse photographs that have each other's names, and warn of those that look different.

    Args:
        views: Photographs as they are now.
        known: What :func:`thumbnails` returned of them before.
        where: The photographs, at the start of a sentence.

    Raises:
        InputError: A photograph looks like another one of ``known``, and not like itself.
    """
    now = thumbnails(views)
    names = [name for name in now if _WRITTEN.fullmatch(str(known.get(name)))]
    if not names:
        return
    levels, before = (
        torch.tensor([list(bytes.fromhex(one[name])) for name in names]).double()
        for one in (now, known)
    )
    differences = torch.cdist(levels, before) / _SIDE
    nearest, like = differences.min(dim=1)
    own = differences.diagonal()
    changed = [(row, name) for row, name in enumerate(names) if float(own[row]) > _SAME]
    moved = [f"{name} shows {names[like[row]]}" for row, name in changed if nearest[row] <= _SAME]
    if moved:
        raise InputError(
            f"{where} have other names now: {some(moved)}; needed: each under the name that the "
            "run read it by. Name the folder of the originals by `--photos DIR` (`photographs=`)."
        )
    if changed:
        caution(
            f"{where} look different now: {some([name for _, name in changed])}. They are written "
            "as they are. Name the folder of the originals by `--photos DIR` (`photographs=`).",
            stacklevel=4,
        )
