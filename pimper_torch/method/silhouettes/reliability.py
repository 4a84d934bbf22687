"""Reliability of silhouettes: every view's cut against the visual hull and the background."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.ground.geometry.opencv import signed_distance
from pimper_torch.ground.shapes import Map, ViewMask
from pimper_torch.method.silhouettes.cuts import DOUBT_OFF_PLANE, Cuts, doubt_of, is_deep
from pimper_torch.records import Silhouettes, Views
from pimper_torch.runtime.mapped import by_view, zeros
from pimper_torch.runtime.parallel import side_by_side

# Fraction of a reliable silhouette that the hull's projection covers. Chosen, as the next two, on
# the four rendered scenes and the skull (benchmarks/silhouettes.py).
_MIN_COVERED = 0.9

# Fraction of it that may show a background for certain: the supporting plane, or a room at rest.
# True masks show up to 0.001, masks 20 px of 640 too wide 0.007 to 0.19 (mug, potatoes and
# scorpion, two of them on turntables).
MAX_EXPOSED = 0.01

# Fraction of the object's points that it holds. True masks hold 0.948 and more, masks 20 px too
# narrow 0.50 to 0.80 (mug, potatoes).
MIN_HELD = 0.9


def agreement_of(cuts: Cuts) -> tuple[Float[Tensor, " view"], ViewMask]:
    """Compare each view's cut with the hull's projection.

    A cut inside the projection contradicts nothing: the others may not see what it takes away, as
    at the end of an arc. A cut outside contradicts them, as where its camera is misplaced. Cuts
    that err alike agree with their hull, but not with background and points.

    Returns:
        Intersection over union of cut and projection; and the views whose cut shows something,
        nearly all of the object and nothing else.
    """

    def areas(mask: Tensor, margin: Tensor) -> Tensor:
        projection = margin > 0
        return torch.stack([one.sum() for one in (mask, mask & projection, mask | projection)])

    own, both, either = by_view(areas, cuts.masks, cuts.margins_px).double().unbind(dim=1)
    reliable = (both / own.clamp_min(1) >= _MIN_COVERED) & (own > 0)
    reliable &= (cuts.exposed <= MAX_EXPOSED) & (cuts.held >= MIN_HELD)
    return both / either.clamp_min(1), reliable


# Probability where the hull denies by more than two pixels what a cut shows.
_UNSURE_INSIDE = 0.6


def silhouettes_of(cuts: Cuts, views: Views) -> Silhouettes:
    """Turn cuts into probabilities at the photographs' size; 0 in the padding."""
    size, device = views.images.shape[-2:], views.images.device

    def enlarged(view: int) -> Map:
        cut, margin = cuts.masks[view], cuts.margins_px[view]
        doubt = torch.where(margin > 2, DOUBT_OFF_PLANE, 0.0)
        if cuts.agreement is not None:
            own = doubt_of(cuts.agreement[view]).masked_fill(is_deep(-margin), 0)
            doubt = torch.maximum(doubt, own)
        layers = torch.stack([signed_distance(cut), margin.clamp(-100, 100), doubt])
        wide = interpolate(layers[None], size, mode="bilinear", align_corners=False)
        border, hull, doubt = wide[0]
        inside = torch.sigmoid(border / 0.5)
        inside = torch.where((border > 2) & (hull < -2), _UNSURE_INSIDE, inside)
        return torch.where(border < -2, torch.maximum(inside, doubt), inside)

    found, within = zeros((len(cuts.masks), *size), device=device), views.inside
    for view, inside in enumerate(side_by_side(enlarged, range(len(cuts.masks)), tracked=False)):
        found[view] = inside.to(device) * within[view]
    hidden = None
    if cuts.hidden is not None:
        hidden = by_view(
            lambda one: interpolate(one[None, None].float(), size)[0, 0] > 0, cuts.hidden
        )
    _, reliable = agreement_of(cuts)
    return Silhouettes(inside=found, reliable=reliable.to(device), source="found", hidden=hidden)
