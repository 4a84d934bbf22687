"""Given masks, checked against cameras and points.

Files may show the object dark, be turned, mirrored or moved, or belong to other photographs. They
are refused if such a reading contradicts cameras and points clearly less than the files as they
are. Single masks that contradict the others are replaced by the hull of those.
"""

from collections import defaultdict
from itertools import compress

import torch

from pimper_torch.geometry.mask_polarity import Raster
from pimper_torch.geometry.visual_hull import bounding_cube, margins, visual_hull
from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.records.shapes import PerView, ViewMask
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.stages.silhouettes.mask_assignment import Reading, likeliest
from pimper_torch.stages.silhouettes.mask_evidence import MARGIN, MaskEvidence

# Most points that contradict a reading, relative to those that contradict the files and absolute;
# those below which files are accepted, and from which on they are said; those of one mask, absolute
# and relative to the median view, and most such masks: docs/decisions.md, "Masks that are turned,
# inverted or of other photographs".
_CLEARLY, _MOST, _LEAST, _SAID = 1 / 4, 0.05, 0.0025, 0.05
_OF_ONE, _BEYOND, _FEW = 0.02, 10.0, 1 / 4
_REFUSED = 0.5  # of the points in the masks of the median view; a choice
# The hull of which a mask has pixels outside, or which it lacks, must be denied by more than this
# fraction of the views. Most of these pixels, of the mask and of the hull: as above.
_DENIED, _EXCESS, _LACK = 0.45, 0.05, 0.75

_TURNS = {
    2: "mirrored",
    3: "turned by a half turn",
    4: "mirrored upside down",
    5: "mirrored and turned by a quarter turn",
    6: "turned by a quarter turn anticlockwise",
    7: "mirrored and turned by a quarter turn",
    8: "turned by a quarter turn clockwise",
}


def refuse_wrong_masks(scene: SparseScene) -> None:
    """Refuse the masks, or else the soft masks, of a scene that cameras and points contradict.

    A warning is given if 5 % of the points contradict masks that are accepted, or many points a few
    of them, and if no point of the cloud is in the silhouettes.

    Raises:
        InputError: The files are inverted, turned, mirrored, moved or named after other
            photographs, or contradict the points in every reading.
    """
    evidence = MaskEvidence.of(scene)
    if evidence is None:
        return
    found, by_view = evidence.of_points(evidence.files)
    if found < _LEAST:
        return
    best, reading = likeliest(evidence)
    if best <= min(_CLEARLY * found, _MOST):
        raise InputError(
            f"The masks contradict {found:.1%} of the points, but {best:.1%} if they are "
            f"{_described(reading, evidence)}. Needed: masks that are bright at the object (or "
            "`--mask-object dark`), oriented like the photographs and named after them."
        )
    given, every = by_view[list(evidence.files)], torch.ones(len(evidence.files)) > 0
    if (refused := float(given.median())) > _REFUSED:
        raise InputError(
            f"The masks contradict {refused:.0%} of the points in the median view; at most: "
            f"{_REFUSED:.0%}. Inverting, turning, mirroring, moving or reordering them does not "
            "help. Check whether they show the same object in all photographs, and whether the "
            "cameras belong to these photographs; or omit the masks."
        )
    if not bool(given.any()):
        caution(
            "No point of the cloud is in the silhouettes of the masks. This is correct if the "
            "object has no texture; otherwise check that the masks show it.",
            stacklevel=3,
        )
    elif found >= _SAID or bool((_against_points(evidence, every) > 1).any()):
        most = by_view.argsort(descending=True)[:3].tolist()
        views = some([f"{evidence.names[view]} ({by_view[view]:.0%})" for view in most])
        caution(
            f"The masks contradict {found:.1%} of the points, most in {views}. Check these masks.",
            stacklevel=3,
        )


def _described(reading: Reading, evidence: MaskEvidence) -> str:
    """Return what files are in a reading, with the files if it is not all of them."""
    names, files = evidence.names, defaultdict(list)
    for (file, view), (turn, inverted) in zip(reading.shown.items(), reading.forms, strict=True):
        if inverted:
            files["inverted: they show the object dark"].append(names[file])
        if turn > 1:
            files[_TURNS[turn]].append(names[file])
        if view != file:
            files["named after other photographs"].append(f"{names[file]} shows {names[view]}")
    right, down = (round(side / evidence.scale) for side in reading.shift)
    sides = (right, "to the right", "to the left"), (down, "down", "up")
    if moved := [f"{abs(x)} pixels {ahead if x > 0 else back}" for x, ahead, back in sides if x]:
        files[f"moved by about {' and '.join(moved)}"] = list(names)
    return " and ".join(
        cause
        if listed[0] in names and len(listed) >= len(evidence.files)
        else f"{cause} ({some(listed, most=4)})"
        for cause, listed in files.items()
    )


def contradictory(scene: SparseScene) -> ViewMask:
    """Return the views whose masks clearly contradict the points or the hull of most masks.

    Returns:
        All views with a mask if fewer than three, or at most half, would agree.
    """
    rejected = torch.zeros(scene.views.num_views, dtype=torch.bool)
    evidence = MaskEvidence.of(scene)
    if evidence is None:
        return rejected
    views = torch.tensor(list(evidence.files))
    kept = torch.ones(len(views), dtype=torch.bool)
    while kept.sum() >= max(3, len(views) // 2 + 1):
        wrong = torch.maximum(_against_points(evidence, kept), _beside_hull(evidence, kept))
        if wrong.max() <= 1:
            rejected[views] = ~kept
            return rejected
        kept[wrong.argmax()] = False
    rejected[views] = True
    return rejected


def _kept(evidence: MaskEvidence, kept: ViewMask) -> dict[int, Raster]:
    return dict(compress(evidence.files.items(), kept))


def _against_points(evidence: MaskEvidence, kept: ViewMask) -> PerView:
    """Return how many points masks contradict, relative to what is accepted in a few of them."""
    by_file = evidence.of_points(_kept(evidence, kept))[1][list(evidence.files)]
    share = by_file / max(_OF_ONE, _BEYOND * float(by_file[kept].median()))
    return share * ((share > 1).float().mean() <= _FEW)


def _beside_hull(evidence: MaskEvidence, kept: ViewMask) -> PerView:
    """Return how far masks exceed the hull of most, or lack it, relative to what is accepted."""
    masks = _kept(evidence, kept)
    cameras = evidence.cameras.take(list(masks))
    high, wide = cameras.sizes_px.amax(dim=0).flip(0).tolist()
    inside = torch.zeros(len(masks), high, wide)
    for into, x in zip(inside, masks.values(), strict=True):
        into[: x.shape[0], : x.shape[1]] = x > 0
    reliable = torch.ones(len(masks), dtype=torch.bool)
    given = Silhouettes(inside=inside, reliable=reliable, source="masks")
    box, hull = bounding_cube(given, cameras), None
    if box is not None:
        hull = visual_hull(given, cameras, box.float(), num_voxels=64**3, disagreeing=_DENIED)
    if hull is None:
        return torch.where(kept, torch.inf, 0.0)
    found, margin = [], MARGIN * max(high, wide)
    for mask, K, pose in zip(
        masks.values(), cameras.intrinsics, cameras.cam_from_world, strict=True
    ):
        depth = margins(hull, K, pose, (mask.shape[1], mask.shape[0]))
        excess = ((mask > 0) & (depth < -margin)).sum() / (mask > 0).sum()
        lack = ((mask < 0) & (depth > margin)).sum() / (depth > margin).sum().clamp_min(1)
        found.append(torch.maximum(excess / _EXCESS, lack / _LACK))
    return torch.zeros(len(kept)).masked_scatter(kept, torch.stack(found))
