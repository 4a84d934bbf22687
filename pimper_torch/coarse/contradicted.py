"""Surface that the photographs contradict: it closes an opening that views look into."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.components import face_components
from pimper_torch.records import Photometry, Support

# Median misfit above which a component is contradicted: in multiples of that of facets with points
# and the same occlusion, and in any case as a fraction of its brightness. Measured, components with
# more than 10 determined facets: 4.9 times and 0.16 for the surface that closes a mug's mouth, 1.2
# and 0.08 for its plain handle and bottom, 1.1 to 1.9 for plain sides of a jar (first round of 16
# photographs of 640x480), 0.9 to 2.0 for a skull's orbits and plain bone (24 photographs, two
# rounds).
_MAX_RATIO, _MIN_MISFIT = 3.0, 0.1

# Facets with points, at least, to compare with. A choice.
_MIN_FACETS = 20

# Of these, the number of nearest occlusion: the median is certain to a sixth of the spread.
_NUM_COMPARED = 50

# Facets that light determines, at least, in a component that can be contradicted: of a few, some
# have a large misfit by chance, and views look into no hole of a few facets. A choice.
_MIN_DETERMINED = 10


def contradicted(
    faces: Int[Tensor, "facet 3"],
    support: Int[Tensor, " facet"],
    misfit: Float[Tensor, " facet"],
    occlusion: Float[Tensor, " facet"],
) -> Bool[Tensor, " facet"]:
    """Mark connected facets that light alone supports and does not explain.

    A surface over the mouth of a vessel is seen by all views, and shows each another part of
    the inside. No light explains that on one surface, while it explains a plain surface as well
    as a textured one. Cast shadows and interreflection are not explained either, and the deeper
    a concavity, the more there is of both: facets are compared with those of the same
    occlusion. On textured surface of three objects, the misfit of facets that are half occluded
    was 2 to 7 times that of unoccluded facets.

    Args:
        faces: Of the coarse mesh.
        support: See :class:`~pimper_torch.records.Support`.
        misfit: Photometric residual over brightness; NaN where there is none.
        occlusion: See :func:`~pimper_torch.geometry.visibility.ambient_occlusion`.

    Returns:
        True for all facets of a component whose median misfit is too large; none where light
        determines too few of them, or too few facets have points to compare with.
    """
    found = torch.zeros_like(support, dtype=torch.bool)
    determined = misfit.isfinite()
    (known,) = torch.nonzero(determined & (support == int(Support.POINTS)), as_tuple=True)
    (light,) = torch.nonzero(support == int(Support.LIGHT), as_tuple=True)
    if len(known) < _MIN_FACETS or len(light) == 0:
        return found
    label = face_components(faces[light])
    for component in range(int(label.max()) + 1):
        members = light[label == component]
        own = members[determined[members]]
        if len(own) >= _MIN_DETERMINED:
            difference = (occlusion[known] - occlusion[own].median()).abs()
            farthest = difference.kthvalue(min(_NUM_COMPARED, len(known))).values
            usual = misfit[known[difference <= farthest]].median()
            found[members] = misfit[own].median() > (_MAX_RATIO * usual).clamp_min(_MIN_MISFIT)
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
