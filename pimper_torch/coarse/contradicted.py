"""Surface that the photographs contradict: it closes what views look into."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.components import face_components
from pimper_torch.records import Photometry, Support

# How many times more the photographs may disagree on surface that light alone supports than on
# surface that points do, and by what share of its brightness in any case. First round of 16
# photographs of 640x480, medians over pieces of more than 50 facets: the lid that closes a mug's
# mouth 4.0 times and 0.15, its plain handle and bottom 2.0 and 0.08, plain sides of a jar 1.1 to
# 3.1 and 0.02 to 0.05.
_MORE, _LEAST = 3.0, 0.1

# Facets that points support, at least, to compare with.
_LEAST_FACETS = 20


def contradicted(
    faces: Int[Tensor, "facet 3"],
    support: Int[Tensor, " facet"],
    misfit: Float[Tensor, " facet"],
) -> Bool[Tensor, " facet"]:
    """Mark connected facets that light alone supports and does not explain.

    A lid over the mouth of a vessel is seen by all views, and shows each another part of the
    inside. No light explains that on one surface, while it explains a plain surface as well as
    a textured one.

    Args:
        faces: Of the coarse mesh.
        support: See :class:`~pimper_torch.records.Support`.
        misfit: Photometric residual over brightness; NaN where there is none.

    Returns:
        All facets of connected ones whose median misfit is too large; none where too few facets
        have points to compare with.
    """
    found = torch.zeros_like(support, dtype=torch.bool)
    judged = misfit.isfinite()
    borne_out = misfit[judged & (support == int(Support.POINTS))]
    (light,) = torch.nonzero(support == int(Support.LIGHT), as_tuple=True)
    if len(borne_out) < _LEAST_FACETS or len(light) == 0:
        return found
    limit = max(_MORE * float(borne_out.median()), _LEAST)
    label = face_components(faces[light])
    for piece in range(int(label.max()) + 1):
        members = light[label == piece]
        told = misfit[members][judged[members]]
        if len(told) and float(told.median()) > limit:
            found[members] = True
    return found


def misfit_of(found: Photometry) -> Float[Tensor, " patch"]:
    """Give the residual of each patch over its brightness; NaN where light does not determine it.

    Args:
        found: Factorized patches.
    """
    valid = found.valid.to(found.albedo)
    count = valid.sum(dim=(1, 2))
    albedo = (found.albedo.mean(dim=-1) * valid).sum(dim=(1, 2)) / count.clamp_min(1)
    strength = found.lights_patch.norm(dim=-1)
    lit = (strength > 0).sum(dim=1).clamp_min(1)
    level = (albedo * strength.sum(dim=1) / lit).detach()
    known = found.determined & (count > 0) & (level > 0)
    residual = found.convergence.residual.detach().to(level)
    return torch.where(known, residual / torch.where(level > 0, level, 1), torch.nan)
