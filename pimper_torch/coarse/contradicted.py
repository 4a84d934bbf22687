"""Surface that the photographs contradict: it closes an opening that views look into."""

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.geometry.topology import face_components
from pimper_torch.records import Photometry, Support

# Misfit above which surface is contradicted: in multiples of that of facets with points and like
# occlusion, and in any case as a fraction of its brightness. Measured, as a component's median
# with more than 10 determined facets: 4.9 times and 0.16 for the surface that closes a mug's mouth,
# 1.2 and 0.08 for its plain handle and bottom, 1.1 to 1.9 for plain sides of a jar (first round of
# 16 photographs of 640x480), 0.9 to 2.0 for a skull's orbits and plain bone (24 photographs, two
# rounds). as local medians: 5.1 to 8.5 for the surface in a mug's mouth connected with its
# inside, 1.3 to 2.2 for the inside (first two rounds of 20 photographs of 800x600).
_MAX_RATIO, _MIN_MISFIT = 3.0, 0.1

# Determined facets of a component, nearest to each of its facets, whose median counts. Of the mug's
# 93 to 98 contradicted facets 10, 20 and 30 find the same to 5.
_NUM_LOCAL = 20

# Facets with points, at least, to compare with. A choice.
_MIN_FACETS = 20

# Of these, the number of nearest occlusion: the median is certain to a sixth of the spread.
_NUM_COMPARED = 50

# Facets that light determines, at least, in a piece that can be contradicted: of a few, some have a
# large misfit by chance, and views look into no hole of a few facets. A choice.
_MIN_DETERMINED = 10


def contradicted(
    centers: Float[Tensor, "facet 3"],
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
        centers: Of the facets; any unit.
        faces: Of the coarse mesh.
        support: See :class:`~pimper_torch.records.Support`.
        misfit: Photometric residual over brightness; NaN where there is none.
        occlusion: See :func:`~pimper_torch.geometry.visibility.ambient_occlusion`.

    Returns:
        True for all facets of a piece whose misfit, as the median over the nearest facets, is too
        large; none where light determines too few of them, or too few facets have points to
        compare with.
    """
    found = torch.zeros_like(support, dtype=torch.bool)
    determined = misfit.isfinite()
    (known,) = torch.nonzero(determined & (support == int(Support.POINTS)), as_tuple=True)
    (light,) = torch.nonzero(support == int(Support.LIGHT), as_tuple=True)
    if len(known) < _MIN_FACETS or len(light) == 0:
        return found
    difference = (occlusion[light, None] - occlusion[known]).abs()
    compared = difference.topk(min(_NUM_COMPARED, len(known)), largest=False).indices
    ratio = misfit[light] / misfit[known][compared].median(dim=1).values
    label = face_components(faces[light])
    for component in range(int(label.max()) + 1):
        (members,) = torch.nonzero(label == component, as_tuple=True)
        own = members[determined[light[members]]]
        if len(own) < _MIN_DETERMINED:
            continue
        near = own[_nearest(centers[light[members]], centers[light[own]])]
        too_large = ratio[near].median(dim=1).values > _MAX_RATIO
        too_large &= misfit[light[near]].median(dim=1).values > _MIN_MISFIT
        found[light[members[too_large]]] = True
    return _large_pieces(faces, found, determined)


def _nearest(
    centers: Float[Tensor, "facet 3"], among: Float[Tensor, "own 3"]
) -> Int[Tensor, "facet near"]:
    """Name the facets whose median stands for each facet."""
    count = min(_NUM_LOCAL, len(among))
    _, near = cKDTree(among.cpu().double().numpy()).query(
        centers.cpu().double().numpy(), k=range(1, count + 1)
    )
    return torch.from_numpy(near).to(centers.device)


def _large_pieces(
    faces: Int[Tensor, "facet 3"],
    chosen: Bool[Tensor, " facet"],
    determined: Bool[Tensor, " facet"],
) -> Bool[Tensor, " facet"]:
    """Keep the connected pieces of chosen facets that hold enough determined ones."""
    (index,) = torch.nonzero(chosen, as_tuple=True)
    if len(index) == 0:
        return chosen
    label = face_components(faces[index])
    counts = torch.zeros(int(label.max()) + 1, dtype=torch.long, device=label.device)
    counts.index_add_(0, label, determined[index].long())
    return chosen.index_fill(0, index[counts[label] < _MIN_DETERMINED], False)


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
