"""Reliability of silhouettes: every view's cut against the visual hull and the background."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.geometry.opencv import signed_distance
from pimper_torch.records import Silhouettes, Views
from pimper_torch.records.shapes import Map, ViewMask
from pimper_torch.runtime.mapped import by_view, zeros
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.silhouettes.cuts import MISS_OFF_PLANE, Cuts, is_deep, miss_probability

# Least fraction of a reliable silhouette that the hull's projection covers. Chosen, as the next
# two, on the four rendered scenes and the skull (benchmarks/studies/silhouettes.py).
_MIN_COVERED = 0.9

# Most of it that may certainly show a background: the supporting plane or a static background. True
# masks have up to 0.001, masks 20 px of 640 too wide 0.007 to 0.19 (mug, potatoes and scorpion, two
# of them on turntables).
MAX_EXPOSED = 0.01

# Least fraction of the object's points that it contains. True masks contain 0.948 and more, masks
# 20 px too narrow 0.50 to 0.80 (mug, potatoes).
MIN_HELD = 0.9


def agreement_of(cuts: Cuts) -> tuple[Float[Tensor, " view"], ViewMask]:
    """Return each view's overlap with the hull's projection, and which views are reliable.

    A cut inside the projection contradicts nothing: the other views may not see the region that it
    excludes, such as at the end of an arc. A cut outside contradicts them, such as with a misplaced
    camera. Cuts with a common error agree with their hull, but not with background and points.

    Returns:
        Intersection over union of cut and projection; and the views whose cut is not empty,
        contains nearly all of the object's points and hardly any background.
    """

    def areas(mask: Tensor, margin: Tensor) -> Tensor:
        projection = margin > 0
        return torch.stack([x.sum() for x in (mask, mask & projection, mask | projection)])

    area, intersection, union = by_view(areas, cuts.masks, cuts.margins_px).double().unbind(dim=1)
    reliable = (intersection / area.clamp_min(1) >= _MIN_COVERED) & (area > 0)
    reliable &= (cuts.exposed <= MAX_EXPOSED) & (cuts.held >= MIN_HELD)
    return intersection / union.clamp_min(1), reliable


# Probability of pixels in a cut that are more than two pixels outside the hull.
_UNSURE_INSIDE = 0.6


def silhouettes_of(cuts: Cuts, views: Views) -> Silhouettes:
    """Convert cuts to probabilities at the photographs' size; 0 in the padding."""
    size, device = views.images.shape[-2:], views.images.device

    def enlarged(view: int) -> Map:
        cut, margin = cuts.masks[view], cuts.margins_px[view]
        missed = torch.where(margin > 2, MISS_OFF_PLANE, 0.0)
        if cuts.agreement is not None:
            off_plane = miss_probability(cuts.agreement[view]).masked_fill(is_deep(-margin), 0)
            missed = torch.maximum(missed, off_plane)
        layers = torch.stack([signed_distance(cut), margin.clamp(-100, 100), missed])
        wide = interpolate(layers[None], size, mode="bilinear", align_corners=False)
        border, hull, missed = wide[0]
        inside = torch.sigmoid(border / 0.5)
        inside = torch.where((border > 2) & (hull < -2), _UNSURE_INSIDE, inside)
        return torch.where(border < -2, torch.maximum(inside, missed), inside)

    probabilities, valid = zeros((len(cuts.masks), *size), device=device), views.inside
    for view, inside in enumerate(side_by_side(enlarged, range(len(cuts.masks)), tracked=False)):
        probabilities[view] = inside.to(device) * valid[view]
    hidden = None
    if cuts.hidden is not None:
        hidden = by_view(
            lambda mask: interpolate(mask[None, None].float(), size)[0, 0] > 0, cuts.hidden
        )
    _, reliable = agreement_of(cuts)
    return Silhouettes(
        inside=probabilities,
        reliable=reliable.to(device),
        source="found",
        hidden=hidden,
        expected_overlap=None if cuts.expected is None else cuts.expected.to(device),
    )
