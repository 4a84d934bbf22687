r"""Seams of neighbouring patches: rays that intersect both, and the equations of the alignment.

The unknown of a patch is :math:`h_\mu = (h_x, h_y, h_z, h_0)`; its height field becomes
:math:`h_\mu^T S` with :math:`S = (x, y, z, 1)`. Lengths in the equations are in units of the median
edge of the mesh, so all terms and weights are dimensionless.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.height_fields import intersect_height_field
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.topology import face_counts, face_edges
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.records import PatchSet, Record
from pimper_torch.records.heights import Depths
from pimper_torch.records.shapes import Faces

Transforms = Float[Tensor, "face 4"]
PerSide = Float[Tensor, "seam 2"]
PerRay = Float[Tensor, "seam 2 row column 3"]
PerSeam = Float[Tensor, " seam"]
Met = Bool[Tensor, "seam row column"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Seams(Record):
    """Rays through the strips along shared edges.

    Attributes:
        origins: A point on each ray, world; rows are lines parallel to the edge.
        directions: Common direction of all rays of a seam: unit bisector of the inward normals.
        normals: Inward unit normals of the two facets, world.
        seam_of: Seam at the edge opposite to each corner of a facet; -1 without a neighbour.
        slot_of: Index of each seam and side in ``seam_of``, flattened.
    """

    facets: Int[Tensor, "seam 2"]
    origins: Float[Tensor, "seam row column 3"]
    directions: Float[Tensor, "seam 3"]
    normals: Float[Tensor, "seam 2 3"]
    edge_lengths: PerSeam
    seam_of: Faces
    slot_of: Int[Tensor, "seam 2"]

    @property
    def units(self) -> Float[Tensor, " 4"]:
        """Factors of transforms from units of the median edge to scene units; the last is it."""
        unit = self.edge_lengths.median()
        return torch.stack([torch.ones_like(unit)] * 3 + [unit])


def find_seams(patches: PatchSet, rows: int, columns: int, reach_samples: float) -> Seams:
    """Return ``rows`` lines of ``columns`` rays along all edges that two facets share.

    Args:
        reach_samples: Distance of the outermost lines to the edge, in template samples.
    """
    frames = per_facet(patches, [bucket.patch_from_world for bucket in patches.buckets]).double()
    spacing = per_facet(patches, [bucket.spacing for bucket in patches.buckets]).double()
    vertices = patches.coarse.mesh.vertices_world.double()
    edges, edge_of = face_edges(patches.coarse.mesh.faces)
    shared = face_counts(edge_of) == 2
    seam_of = torch.where(shared, shared.cumsum(dim=0) - 1, -1)[edge_of]
    slot = edge_of.flatten().argsort(stable=True)
    slot_of = slot[seam_of.flatten()[slot] >= 0].reshape(-1, 2)
    facets = slot_of // 3
    normals = frames[facets, 2, :3]
    directions = normalize(normals.sum(dim=1), dim=-1)
    start, end = vertices[edges[shared]].unbind(dim=1)
    edge_lengths = (end - start).norm(dim=-1)
    across = normalize(torch.linalg.cross(directions, end - start), dim=-1)

    along = (torch.arange(columns, device=start.device, dtype=start.dtype) + 0.5) / columns
    offset = torch.linspace(-1, 1, rows, device=start.device, dtype=start.dtype)
    reach = reach_samples * spacing[facets].mean(dim=1)
    on_edge = start[:, None] + along[:, None] * (end - start)[:, None]
    shift = (reach[:, None] * offset)[..., None] * across[:, None]
    return Seams(
        facets=facets,
        origins=on_edge[:, None] + shift[:, :, None],
        directions=directions,
        normals=normals,
        edge_lengths=edge_lengths,
        seam_of=seam_of,
        slot_of=slot_of,
    )


def intersect_overlaps(
    seams: Seams, patches: PatchSet, buckets: tuple[Depths, ...], transforms: Transforms
) -> tuple[PerRay, PerRay, Met]:
    """Intersect the rays of every seam with both height fields, as currently transformed.

    Returns:
        ``(x, y, z)`` of each patch's height field before any transform, patch frame; the foot
        points on the facets' planes, world; and a mask of rays that hit both height fields.

    Differentiable in the depths and the transforms.
    """
    results = []
    for templates, depths in zip(patches.buckets, buckets, strict=True):
        index = seams.seam_of[templates.facet]
        seam = index.clamp_min(0)
        patch_from_world = templates.patch_from_world.double()
        origins_world = seams.origins.flatten(1, 2)[seam]
        directions_world = seams.directions[seam][:, :, None].expand_as(origins_world)
        origins = transform(patch_from_world, origins_world.flatten(1, 2))
        directions = rotate(patch_from_world, directions_world.flatten(1, 2))
        # The inversely transformed ray is intersected with the untransformed height field.
        hx, hy, hz, h0 = transforms[templates.facet][:, :, None].unbind(dim=1)
        height = origins[..., 2] - hx * origins[..., 0] - hy * origins[..., 1] - h0
        sinking = directions[..., 2] - hx * directions[..., 0] - hy * directions[..., 1]
        points, hit = intersect_height_field(
            depths.depth,
            depths.valid,
            templates.origin.double(),
            templates.spacing.double(),
            torch.cat([origins[..., :2], (height / hz)[..., None]], dim=-1),
            torch.cat([directions[..., :2], (sinking / hz)[..., None]], dim=-1),
        )
        feet = torch.cat([points[..., :2], torch.zeros_like(points[..., :1])], dim=-1)
        feet_world = transform(invert_rigid(patch_from_world), feet)
        shape = origins_world.shape
        met = hit.reshape(shape[:3]) & (index >= 0)[..., None]
        results.append((points.reshape(shape), feet_world.reshape(shape), met))
    raster = seams.origins.shape[1:3]
    joined = [per_facet(patches, values).flatten(0, 1) for values in zip(*results, strict=True)]
    samples, feet, met = (
        values[seams.slot_of].reshape(*seams.slot_of.shape, *raster, *values.shape[2:])
        for values in joined
    )
    return samples, feet, met.all(dim=1)


def per_facet(patches: PatchSet, values: Iterable[Tensor]) -> Tensor:
    """Return the values of all buckets, concatenated in the order of the facets."""
    order = torch.argsort(torch.cat([templates.facet for templates in patches.buckets]))
    return torch.cat(list(values))[order]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class AlignTerms(Record):
    """The terms of the alignment.

    Attributes:
        normals: Inward unit normals of the facets, world.
        samples: ``S`` of both height fields where a ray hits them.
        gap: Foot point of the first sample minus that of the second, world.
        weight: Weight of each ray, 0 where ignored; the sum over a seam is at most 1.
        curvature: ``C`` of both height fields before any transform; see :func:`curvature_along`.
        corners: ``S`` of every height field at its facet's corners.
        prior_weight: Weight of the identity for each component of h; infinite for fixed ones.
    """

    facets: Int[Tensor, "seam 2"]
    normals: Float[Tensor, "seam 2 3"]
    samples: Float[Tensor, "seam 2 ray 4"]
    gap: Float[Tensor, "seam ray 3"]
    weight: Float[Tensor, "seam ray"]
    curvature: PerSide
    corners: Float[Tensor, "face 3 4"]
    corner_weight: Float[Tensor, "face 3"]
    prior_weight: Float[Tensor, " 4"]


def mismatches(terms: AlignTerms, transforms: Transforms) -> Float[Tensor, "seam ray 3"]:
    r"""Return :math:`P_\mu + N_\mu h_\mu^T S_\mu - P_{\mu'} - N_{\mu'} h_{\mu'}^T S_{\mu'}`."""
    heights = torch.einsum("perc,pec->per", terms.samples, transforms[terms.facets])
    lifted = heights[..., None] * terms.normals[:, :, None]
    return terms.gap + lifted[:, 0] - lifted[:, 1]


def curvature_along(
    heights: Float[Tensor, "seam 2 row column"], met: Met, edge_lengths: PerSeam
) -> PerSide:
    r"""Return the mean square of a height field's curvature along the edge, times its length.

    :math:`C = \overline{(\ell\,\kappa)^2}`, :math:`\kappa` by second differences over a
    quarter of the edge :math:`\ell`, a distance at which noise of normals averages out.
    """
    columns = heights.shape[-1]
    stride = max(1, columns // 4)
    centre = heights[..., stride:-stride]
    step = heights[..., 2 * stride :] - 2 * centre + heights[..., : -2 * stride]
    valid = met[..., 2 * stride :] & met[..., stride:-stride] & met[..., : -2 * stride]
    bend = step * (columns / stride) ** 2 / edge_lengths[:, None, None, None]
    square = torch.where(valid[:, None], bend, 0).square().sum(dim=(-2, -1))
    return square / valid.sum(dim=(-2, -1)).clamp_min(1)[:, None]


def seam_stiffness(curvature: PerSide, scales: PerSide, square: PerSeam) -> tuple[PerSeam, PerSide]:
    r"""Return the published :math:`k = 1 / \sum (C_\mu + C_{\mu'})`, and its derivative's term.

    Args:
        scales: ``h_z`` of both patches; ``C`` is proportional to its square.
        square: :math:`\overline{|r|^2}` of the rays.

    Returns:
        k, which is finite for flat neighbours; and the terms of its derivative in right-hand sides.
    """
    # The floor is C of an arc with a sagitta of 0.7 % of its edge's length.
    stiffness = 1 / (3e-3 + (curvature * scales.square()).sum(dim=1))
    return stiffness, (stiffness.square() * square)[:, None] * curvature * scales


def solve_transforms(
    terms: AlignTerms, transforms: Transforms, stiffness: PerSeam, uplift: PerSide
) -> Transforms:
    r"""Return the transforms that minimize the weighted squares of all terms.

    .. math::
        \sum_{seams} k \sum_{rays} w |r|^2 + \sum_{corners} w (h^T S)^2
        + \sum_{patches} \sum_c w_c (h_c - e_c)^2

    Args:
        transforms: Current ones; fixed components keep their values.
        uplift: Added to the right-hand sides of both ``h_z`` of a seam; see
            :class:`~pimper_torch.paper.align.Align`.
    """
    free = torch.nonzero(terms.prior_weight.isfinite()).flatten()
    identity = terms.prior_weight.new_tensor([0, 0, 1, 0])
    fixed = torch.where(terms.prior_weight.isfinite(), 0, transforms)
    samples, corners = terms.samples[..., free], terms.corners[..., free]
    # Contributions of the fixed components.
    gap = mismatches(terms, fixed)
    height = (terms.corners * fixed[:, None]).sum(dim=-1)

    # Derivative of the mismatch of each ray by the unknowns of both patches.
    normals = torch.stack([terms.normals[:, 0], -terms.normals[:, 1]], dim=1)
    slope = torch.einsum("perc,pex->prxec", samples, normals).flatten(3)
    weighted = (stiffness[:, None] * terms.weight)[..., None, None] * slope
    seam_rhs = uplift[..., None] * identity[free]
    seam_rhs = seam_rhs.flatten(1) - torch.einsum("prxk,prx->pk", weighted, gap)
    anchored, prior = terms.corner_weight[..., None] * corners, terms.prior_weight[free]
    rhs = prior * identity[free] - torch.einsum("fvc,fv->fc", anchored, height)
    unknown = torch.arange(rhs.numel(), device=rhs.device).reshape(rhs.shape)
    of_seam = unknown[terms.facets].flatten(1)
    rhs = rhs.flatten().index_add(0, of_seam.flatten(), seam_rhs.flatten())
    blocks = [
        (unknown, torch.einsum("fvc,fvd->fcd", anchored, corners) + prior.diag()),
        (of_seam, torch.einsum("prxk,prxl->pkl", weighted, slope)),
    ]
    rows = [index[:, :, None].expand_as(block).flatten() for index, block in blocks]
    cols = [index[:, None].expand_as(block).flatten() for index, block in blocks]
    values = torch.cat([block.flatten() for _, block in blocks])
    name = "the alignment of the patches"
    factor = SparseCholesky(torch.cat(rows), torch.cat(cols), values, len(rhs), name)
    return fixed.index_copy(1, free, factor.solve(rhs).reshape(unknown.shape))
