r"""The alignment's equations: one small block per patch, one per seam.

Unknown is :math:`h_\mu = (h_x, h_y, h_z, h_0)` of every patch; its height field becomes
:math:`h_\mu^T S` with :math:`S = (x, y, z, 1)`. Lengths are in units of one length of the
mesh, so that all terms, and their weights, have no unit.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pulls(Record):
    """What asks the transforms to change.

    Attributes:
        normals: Their inward unit normals, world.
        samples: ``S`` of both height fields where a ray meets them.
        gap: Foot point of the first sample minus that of the second, world.
        weight: Of each ray; 0 where it does not count. Sums to at most 1 over a seam.
        curvature: ``C`` of both height fields before any transform; see :func:`curvature_along`.
        corners: ``S`` of every height field at its facet's corners.
        corner_weight: How strongly each corner is to stay where it is.
        prior_weight: How strongly each component of h is held at the identity.
    """

    facets: Int[Tensor, "seam 2"]
    normals: Float[Tensor, "seam 2 3"]
    samples: Float[Tensor, "seam 2 ray 4"]
    gap: Float[Tensor, "seam ray 3"]
    weight: Float[Tensor, "seam ray"]
    curvature: Float[Tensor, "seam 2"]
    corners: Float[Tensor, "face 3 4"]
    corner_weight: Float[Tensor, "face 3"]
    prior_weight: Float[Tensor, " 4"]


def mismatches(pulls: Pulls, transforms: Float[Tensor, "face 4"]) -> Float[Tensor, "seam ray 3"]:
    r"""Return :math:`P_\mu + N_\mu h_\mu^T S_\mu - P_{\mu'} - N_{\mu'} h_{\mu'}^T S_{\mu'}`."""
    heights = torch.einsum("perc,pec->per", pulls.samples, transforms[pulls.facets])
    lifted = heights[..., None] * pulls.normals[:, :, None]
    return pulls.gap + lifted[:, 0] - lifted[:, 1]


def curvature_along(
    heights: Float[Tensor, "seam 2 row column"],
    met: Bool[Tensor, "seam row column"],
    edge_lengths: Float[Tensor, " seam"],
) -> Float[Tensor, "seam 2"]:
    r"""Return the mean square of a height field's curvature along the edge, times its length.

    :math:`C = \overline{(\ell\,\kappa)^2}`, :math:`\kappa` by second differences over a
    quarter of the edge :math:`\ell`, for normals' noise lives at shorter distances. An arc
    over the edge whose centre stands out by a tenth of its length has C = 0.64.
    """
    columns = heights.shape[-1]
    stride = max(1, columns // 4)
    ahead, centre, behind = (
        raster[..., start : columns - 2 * stride + start]
        for raster, start in ((heights, 2 * stride), (heights, stride), (heights, 0))
    )
    known = met[..., 2 * stride :] & met[..., stride:-stride] & met[..., : -2 * stride]
    bend = (
        (ahead - 2 * centre + behind) * (columns / stride) ** 2 / edge_lengths[:, None, None, None]
    )
    square = torch.where(known[:, None], bend, 0).square().sum(dim=(-2, -1))
    return square / known.sum(dim=(-2, -1)).clamp_min(1)[:, None]


def seam_stiffness(
    curvature: Float[Tensor, "seam 2"],
    scales: Float[Tensor, "seam 2"],
    floor: float,
) -> Float[Tensor, " seam"]:
    r"""Return the published :math:`k = 1 / \sum (C_\mu + C_{\mu'})`, guarded.

    Args:
        curvature: ``C`` before any transform.
        scales: ``h_z`` of both patches; ``C`` grows with its square.
        floor: Added to the sum, so that flat neighbours have a finite k.
    """
    return 1 / (floor + (curvature * scales.square()).sum(dim=1))


def solve_transforms(
    pulls: Pulls,
    transforms: Float[Tensor, "face 4"],
    stiffness: Float[Tensor, " seam"],
    uplift: Float[Tensor, "seam 2"],
) -> Float[Tensor, "face 4"]:
    r"""Find the transforms that minimise the weighted squares of everything in ``pulls``.

    .. math::
        \sum_{seams} k \sum_{rays} w |r|^2 + \sum_{corners} w (h^T S)^2
        + \sum_{patches} \sum_c w_c (h_c - e_c)^2

    Args:
        pulls: The terms; components whose ``prior_weight`` is infinite are not free.
        transforms: Those so far; components that are not free keep their values.
        stiffness: ``k`` of every seam.
        uplift: Added to the right-hand sides of both ``h_z`` of a seam; see
            :class:`~pimper_torch.paper.alignment.align.Align`.
    """
    free = torch.nonzero(pulls.prior_weight.isfinite()).flatten()
    if len(free) == 0:
        return transforms
    identity = pulls.prior_weight.new_tensor([0, 0, 1, 0])
    fixed = torch.where(pulls.prior_weight.isfinite(), 0, transforms)
    samples, corners = pulls.samples[..., free], pulls.corners[..., free]
    # What components that are not free contribute counts as given.
    gap = mismatches(pulls, fixed)
    given = (pulls.corners * fixed[:, None]).sum(dim=-1)

    weight = stiffness[:, None] * pulls.weight
    weighted = weight[:, None, :, None] * samples
    own = torch.einsum("perc,perd->pecd", weighted, samples)
    cosine = (pulls.normals[:, 0] * pulls.normals[:, 1]).sum(dim=-1)
    cross = -cosine[:, None, None] * torch.einsum("prc,prd->pcd", weighted[:, 0], samples[:, 1])
    along = torch.einsum("pex,prx->per", pulls.normals, gap)
    wanted = torch.einsum("perc,per->pec", weighted, along)
    wanted = torch.stack([-wanted[:, 0], wanted[:, 1]], dim=1)
    wanted = wanted + uplift[..., None] * identity[free]

    held = pulls.corner_weight[..., None] * corners
    diagonal = torch.einsum("fvc,fvd->fcd", held, corners)
    prior = pulls.prior_weight[free]
    diagonal = diagonal + torch.diag(prior)
    rhs = prior * identity[free] - torch.einsum("fvc,fv->fc", held, given)
    first, second = pulls.facets.unbind(dim=1)
    diagonal = diagonal.index_add(0, first, own[:, 0]).index_add(0, second, own[:, 1])
    rhs = rhs.index_add(0, first, wanted[:, 0]).index_add(0, second, wanted[:, 1])

    every = torch.arange(len(transforms), device=first.device)
    rows, cols, values = scatter_blocks(
        torch.cat([every, first, second]),
        torch.cat([every, second, first]),
        torch.cat([diagonal, cross, cross.mT]),
    )
    factor = SparseCholesky(rows, cols, values, rhs.numel(), "the alignment of the patches")
    found = factor.solve(rhs.reshape(-1))
    return fixed.index_copy(1, free, found.reshape(len(transforms), -1))


def scatter_blocks(
    block_rows: Int[Tensor, " block"],
    block_cols: Int[Tensor, " block"],
    blocks: Float[Tensor, "block unknown unknown"],
) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"], Float[Tensor, " entry"]]:
    """Spread small dense blocks into the entries of a sparse matrix.

    Args:
        blocks: Square, all of one size.

    Returns:
        Rows, columns and values for :class:`SparseCholesky`; duplicates are left to it.
    """
    side = blocks.shape[-1]
    within = torch.arange(side, device=blocks.device)
    rows = (side * block_rows[:, None, None] + within[:, None]).expand(blocks.shape)
    cols = (side * block_cols[:, None, None] + within).expand(blocks.shape)
    return rows.reshape(-1), cols.reshape(-1), blocks.reshape(-1)
