"""Cuts at the working size as silhouettes of the photographs."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.mapped import by_view, zeros
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Silhouettes, Views
from pimper_torch.silhouettes.agreement import agreement_of, repaired
from pimper_torch.silhouettes.cuts import Cuts
from pimper_torch.silhouettes.opencv import signed_distance
from pimper_torch.silhouettes.settings import SilhouetteDetails

# Probabilities where a view's cut and the hull contradict each other by more than two pixels.
_UNSURE_INSIDE, _UNSURE_OUTSIDE = 0.6, 0.3
_SOFT = 0.5  # working pixels: the width of a border


def silhouettes_of(cuts: Cuts, views: Views, details: SilhouetteDetails) -> Silhouettes:
    """Repair single cuts, and give silhouettes at the photographs' size."""
    cuts = repaired(cuts)
    found = _at_full_size(cuts, views)
    reliable = agreement_of(cuts).reliable(details).to(found.device)
    hidden = None
    if cuts.hidden is not None:
        size = views.images.shape[-2:]
        hidden = by_view(
            lambda one: interpolate(one[None, None].float(), size)[0, 0] > 0, cuts.hidden
        )
    return Silhouettes(inside=found, reliable=reliable, source="found", hidden=hidden)


def _at_full_size(cuts: Cuts, views: Views) -> Float[Tensor, "view height width"]:
    """Turn cuts into probabilities at the photographs' size; 0 in the padding."""
    height, width = views.images.shape[-2:]
    device = views.images.device

    def enlarged(view: int) -> Float[Tensor, "height width"]:
        cut, margin = cuts.masks[view], cuts.margins_px[view]
        layers = torch.stack([signed_distance(cut), margin.clamp(-100, 100)])
        border, hull = interpolate(
            layers[None], (height, width), mode="bilinear", align_corners=False
        )[0]
        inside = torch.sigmoid(border / _SOFT)
        inside = torch.where((border > 2) & (hull < -2), _UNSURE_INSIDE, inside)
        return torch.where((border < -2) & (hull > 2), _UNSURE_OUTSIDE, inside)

    found, within = zeros((len(cuts.masks), height, width), device=device), views.inside
    for view, inside in enumerate(side_by_side(enlarged, range(len(cuts.masks)), tracked=False)):
        found[view] = inside.to(device) * within[view]
    return found
