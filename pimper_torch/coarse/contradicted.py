"""Surface that the photographs contradict: it closes what views look into."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.components import face_components
from pimper_torch.records import Photometry, Support

# How many times more the photographs may disagree on surface that light alone supports than on
# surface that points do and that is as occluded, and by what fraction of its brightness in any
# case. Pieces with more than 10 determined facets: the lid that closes a mug's mouth 4.9 times and
# 0.16, its plain handle and bottom 1.2 and 0.08, plain sides of a jar 1.1 to 1.9 (first round of 16
# photographs of 640x480), a skull's orbits and plain bone 0.9 to 2.0 (24 photographs, two rounds).
_MORE, _LEAST = 3.0, 0.1

# Facets that points support, at least, to compare with.
_MIN_FACETS = 20

# Of these, how many of about the same occlusion: their median is certain to a sixth of the spread.
_ALIKE = 50

# Facets that light determines, at least, in a piece that can be contradicted: of a few, some are
# explained badly by chance, and a hole of a few facets is none that views look into.
_MIN_TOLD = 10


def contradicted(
    faces: Int[Tensor, "facet 3"],
    support: Int[Tensor, " facet"],
    misfit: Float[Tensor, " facet"],
    occlusion: Float[Tensor, " facet"],
) -> Bool[Tensor, " facet"]:
    """Mark connected facets that light alone supports and does not explain.

    A lid over the mouth of a vessel is seen by all views, and shows each another part of the
    inside. No light explains that on one surface, while it explains a plain surface as well as
    a textured one. Cast shadows and interreflection are not explained either, and the deeper a
    concavity, the more there is of both: facets are compared with those that are as occluded.
    On textured surface of three objects, the misfit of facets that are half occluded was 2 to 7
    times that of facets that nothing occludes.

    Args:
        faces: Of the coarse mesh.
        support: See :class:`~pimper_torch.records.Support`.
        misfit: Photometric residual over brightness; NaN where there is none.
        occlusion: See :func:`~pimper_torch.geometry.visibility.ambient_occlusion`.

    Returns:
        All facets of connected ones whose median misfit is too large; none where light determines
        too few of them, or too few facets have points to compare with.
    """
    found = torch.zeros_like(support, dtype=torch.bool)
    judged = misfit.isfinite()
    known = judged & (support == int(Support.POINTS))
    (light,) = torch.nonzero(support == int(Support.LIGHT), as_tuple=True)
    if int(known.sum()) < _MIN_FACETS or len(light) == 0:
        return found
    label = face_components(faces[light])
    for piece in range(int(label.max()) + 1):
        members = light[label == piece]
        told = members[judged[members]]
        if len(told) >= _MIN_TOLD:
            usual = _usual(misfit[known], occlusion[known], occlusion[told].median())
            found[members] = misfit[told].median() > torch.clamp(_MORE * usual, min=_LEAST)
    return found


def _usual(
    misfit: Float[Tensor, " known"], occlusion: Float[Tensor, " known"], at: Float[Tensor, ""]
) -> Float[Tensor, ""]:
    """Give the median misfit of the facets whose occlusion is nearest."""
    away = (occlusion - at).abs()
    farthest = away.kthvalue(min(_ALIKE, len(away))).values
    return misfit[away <= farthest].median()


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
