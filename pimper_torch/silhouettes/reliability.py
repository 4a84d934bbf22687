"""Reliability of silhouettes: every view's cut against the visual hull and the background."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.ledger import leave_out
from pimper_torch.mapped import by_view, zeros
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Record, Silhouettes, Views
from pimper_torch.silhouettes.cuts import Cuts
from pimper_torch.silhouettes.opencv import blind_holes, components_of, signed_distance
from pimper_torch.silhouettes.seeds import is_deep
from pimper_torch.silhouettes.silhouette_config import SilhouetteDetails

# On rendered scenes, 99 in 100 pixels of a median view's cut lie less than 0.4 pixels of 640
# outside; one of 16 to 30 views holds a shadow of 2 to 9 % of its cut.
_FAR = 1 / 200  # of the pictures' longer side, outside the projection
_LEAST, _MOST = 0.005, 0.2  # of a cut, so far outside
_MANY = 0.5  # of the views
_SHIFTED = 0.5  # of what is outside is missing elsewhere
_WELL = 2.0  # times as deep as is_deep asks for: beside a skull's cheek bone views see through
_SHALLOW = 0.2  # of a hole: more lies near the projection's border where it is seen through


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Agreement(Record):
    """Each view's cut against the hull's projection.

    A cut inside the projection contradicts nothing: the others may not see what it takes away,
    as at the end of an arc. A cut outside contradicts them, as where its camera is misplaced.

    Attributes:
        covered: Fraction of the cut that is inside the projection.
        extent: Fraction of the picture that the cut takes.
        exposed: Fraction of the cut that shows a background for certain.
        held: Fraction of the object's points in the cut. Cuts that err alike agree with their hull,
            but not with background and points.
    """

    overlap: Float[Tensor, " view"]
    covered: Float[Tensor, " view"]
    extent: Float[Tensor, " view"]
    exposed: Float[Tensor, " view"]
    held: Float[Tensor, " view"]

    def reliable(self, details: SilhouetteDetails) -> Bool[Tensor, " view"]:
        """Find views whose cut shows something, nearly all of the object and nothing else."""
        hull = (self.covered >= details.min_covered) & (self.extent > 0)
        return hull & (self.exposed <= details.max_exposed) & (self.held >= details.min_held)


def agreement_of(cuts: Cuts) -> Agreement:
    """Compare the cuts with the projections."""

    def areas(mask: Tensor, margin: Tensor) -> Tensor:
        projection = margin > 0
        return torch.stack([one.sum() for one in (mask, mask & projection, mask | projection)])

    own, both, either = by_view(areas, cuts.masks, cuts.margins_px).double().unbind(dim=1)
    return Agreement(
        overlap=both / either.clamp_min(1),
        covered=both / own.clamp_min(1),
        extent=own / cuts.masks[0].numel(),
        exposed=cuts.exposed,
        held=cuts.held,
    )


def repaired(cuts: Cuts) -> Cuts:
    """Repair single cuts that the hull denies: shadows taken in, highlights left out.

    A supporting plane shows shadows, and what is seen through a hole is known there
    (:func:`~pimper_torch.silhouettes.seeds.filled`); without a plane the hull tells of holes.
    """
    return _without_shadows(cuts) if cuts.on_plane else _without_holes(cuts)


def _without_holes(cuts: Cuts) -> Cuts:
    """Fill holes deep inside the projection, as a highlight makes them in a single view."""

    def filled(mask: Tensor, margin: Tensor) -> Tensor:
        return mask | blind_holes(mask, ~is_deep(margin / _WELL), _SHALLOW)

    return cuts.replace(masks=by_view(filled, cuts.masks, cuts.margins_px))


def _without_shadows(cuts: Cuts) -> Cuts:
    """Take from single cuts what the hull denies, as the shadow beside an object's foot.

    Shadows move with the light, so that one view's cut holds a shadow that the others cut away.
    Nothing is taken where another cause is likelier: where most cuts exceed the projections, as
    the hull has lost a part then; where a cut exceeds the projection on one side and lacks
    something on the other, as a misplaced camera makes it; where a cut has little to do with the
    projection.
    """
    far = _FAR * max(cuts.masks.shape[1:])
    excess = cuts.masks & (cuts.margins_px < -far)
    missing = ~cuts.masks & (cuts.margins_px > far)
    own, over, lost = (layer.sum(dim=(1, 2)) for layer in (cuts.masks, excess, missing))
    exceeds = over > _LEAST * own
    if float(exceeds.double().mean()) > _MANY:
        return cuts
    masks = cuts.masks.clone()
    for view in (exceeds & (over < _MOST * own) & (lost <= _SHIFTED * over)).nonzero()[:, 0]:
        outside = masks[view] & (cuts.margins_px[view] < -far / 2)
        masks[view] &= ~components_of(outside, excess[view])
    leave_out("silhouettes.shadows", cuts.masks & ~masks)
    return cuts.replace(masks=masks)


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
