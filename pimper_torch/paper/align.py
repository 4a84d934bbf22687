"""Alignment of neighbouring patches by bas-relief transforms."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.geometry.rigid import transform
from pimper_torch.linalg.sums import average
from pimper_torch.paper.paper_config import AlignConfig
from pimper_torch.paper.seams import (
    AlignTerms,
    Seams,
    Transforms,
    curvature_along,
    find_seams,
    intersect_overlaps,
    mismatches,
    per_facet,
    seam_stiffness,
    solve_transforms,
)
from pimper_torch.records import AlignStatus, DepthPatches, Depths, PatchSet, Record
from pimper_torch.records.shapes import Scalar
from pimper_torch.runtime.progress import report
from pimper_torch.stages.stage import Stage


def patch_status(
    facets: Int[Tensor, "seam 2"], met: Bool[Tensor, "seam ray"], count: int
) -> Int[Tensor, " face"]:
    """Return the :class:`~pimper_torch.records.AlignStatus` of every patch."""
    overlapping = met.sum(dim=1) >= 0.25 * met.shape[1]
    status = torch.full((count,), int(AlignStatus.ALONE), device=facets.device)
    status[facets[overlapping].flatten()] = int(AlignStatus.ALIGNED)
    return status


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Anchors(Record):
    """The vertices of every facet, which its height field should pass through.

    Attributes:
        samples: ``(x, y, z)`` of the untransformed height field at the vertex, patch frame.
        variance: Variance of the vertex along the facet's normal, scene units squared.
        valid: True if the height field is valid at the vertex.
    """

    samples: Float[Tensor, "face 3 3"]
    variance: Float[Tensor, "face 3"]
    valid: Bool[Tensor, "face 3"]


def vertex_anchors(patches: PatchSet, buckets: tuple[Depths, ...]) -> Anchors:
    """Return the anchors of every height field at its facet's three vertices."""
    mesh, covariance = patches.coarse.mesh, patches.coarse.covariance_world
    vertices = mesh.vertices_world[mesh.faces].double()
    if covariance is None:
        covariance = vertices.new_zeros(len(mesh.vertices_world), 3, 3)
    results = []
    for templates, depths in zip(patches.buckets, buckets, strict=True):
        facet, frames = templates.facet, templates.patch_from_world.double()
        across = transform(frames, vertices[facet])[..., :2]
        grid = templates.origin.double(), templates.spacing.double()
        height = sample_raster(depths.depth[:, None], across, *grid, valid=depths.valid)
        support = sample_raster(depths.valid[:, None].to(depths.depth), across, *grid)
        normal, spread = frames[:, 2, :3], covariance[mesh.faces[facet]].double()
        variance = torch.einsum("fi,fvij,fj->fv", normal, spread, normal).clamp_min(0)
        results.append((torch.cat([across, height.mT], dim=-1), variance, support[:, 0] > 0.5))
    samples, variance, valid = (per_facet(patches, values) for values in zip(*results, strict=True))
    return Anchors(samples=samples, variance=variance, valid=valid)


# Solves within the first round, until weights that depend on the solution converge; later rounds
# start closer to it and need one less.
_REWEIGHTINGS = 3


# Lines of samples across each overlap, samples along each, and the distance of the outermost lines
# to the edge in template samples; `paper` has overlaps of 6.
_ROWS, _COLUMNS, _REACH = 3, 12, 5.0


class Align(Stage):
    r"""Estimate the bas-relief transform that photometry leaves undetermined in each patch.

    The height field z of a patch can be changed to :math:`h^T S`, :math:`S = (x, y, z)` in its
    frame, without contradicting its photographs. All h are estimated together: rays along the
    bisector of two facets' normals intersect both height fields over their shared edge, and

    .. math::
        \min_h \sum_{seams} k \, \overline{| P_\mu + N_\mu h_\mu^T S_\mu
        - P_{\mu'} - N_{\mu'} h_{\mu'}^T S_{\mu'} |^2}

    with P the foot points on the facets' planes and N their normals. Each round intersects the
    overlaps again and solves one sparse linear system.

    :math:`k = 1 / \sum (C_\mu + C_{\mu'})`, with C the mean square of the height field's
    curvature along the seam times the edge's length. C is proportional to :math:`h_z^2`, so
    flattening both height fields does not reduce :math:`k |r|^2`. The derivative of k enters the
    right-hand side of :math:`h_z`, as :math:`k^2 C h_z \overline{|r|^2}` from the previous solve.

    Over coplanar facets, height fields still agree after a common affine change, and
    :math:`h = 0` has no error. Folds determine scales. Anchors, which keep each height field at
    its facet's vertices, determine tilts. The prior toward the identity determines the rest. A
    patch without overlap stays on the mesh, at its anchors.

    Invariant to rigid motions and the scale of the world. Differentiable in the depths.

    Source: Sabzevari, Del Bue, Murino: PiMPeR, 2015, for the system and k, not anchors and rounds.
    """

    kept_as = DepthPatches

    def __init__(self, config: AlignConfig | None = None) -> None:
        super().__init__()
        self.config = config or AlignConfig()

    def forward(self, depths: DepthPatches) -> DepthPatches:
        """Return the aligned depths of all patches.

        Returns:
            Depths with their transform and :class:`~pimper_torch.records.AlignStatus`, and the
            distance of neighbours before and after each round. The input if no patches overlap.
        """
        config, patches = self.config, depths.patches
        seams = find_seams(patches, _ROWS, _COLUMNS, _REACH)
        if len(seams.facets) == 0:
            return depths
        anchors = vertex_anchors(patches, depths.buckets)
        # h_0 is in units of the edge length here, so all terms of the system are dimensionless.
        identity = seams.origins.new_tensor([0, 0, 1, 0])
        transforms = identity.expand(patches.num_patches, 4)
        distances = []
        for done in range(config.iterations):
            terms = self._intersected(depths, seams, anchors, transforms)
            if not bool((terms.weight > 0).any()):
                return depths
            distances.append(_root_mean_square(terms, transforms))
            transforms = self._solve_round(terms, transforms, fresh=done == 0)
            report(done + 1, config.iterations)
        with torch.no_grad():
            terms = self._intersected(depths, seams, anchors, transforms)
            status = patch_status(terms.facets, terms.weight > 0, len(transforms))
        aligned = (status == int(AlignStatus.ALIGNED))[:, None]
        if not bool(aligned.all()):
            # Without seams, each height field follows its anchors.
            zero = torch.zeros_like(terms.curvature)
            on_mesh = solve_transforms(terms, identity.expand_as(transforms), zero[:, 0], zero)
            on_mesh = _limit_scales(on_mesh, config.scale_limit)
            transforms = torch.where(aligned, transforms, on_mesh)
            with torch.no_grad():
                terms = self._intersected(depths, seams, anchors, transforms)
        mismatch = torch.stack([*distances, _root_mean_square(terms, transforms)]) * seams.units[3]
        return depths.replace(
            buckets=_apply(depths, transforms * seams.units, status),
            mismatch=mismatch.detach().to(depths.buckets[0].depth),
        )

    def _intersected(
        self, depths: DepthPatches, seams: Seams, anchors: Anchors, transforms: Transforms
    ) -> AlignTerms:
        """Return the terms of seams with the current transforms, and of anchors at vertices."""
        unit, coarse = seams.units[3], depths.patches.coarse
        in_scene = transforms * seams.units
        samples, feet, hit = intersect_overlaps(seams, depths.patches, depths.buckets, in_scene)
        met = hit.flatten(1)
        prior = unit.new_full((4,), self.config.prior)
        prior[3] = torch.inf  # patches do not move along their normals
        count = met.sum(dim=1).clamp_min(met.shape[1] // 4)  # few rays have less weight
        corners = pad(anchors.samples / unit, (0, 1), value=1.0)
        terms = AlignTerms(
            facets=seams.facets,
            normals=seams.normals,
            samples=pad(samples.flatten(2, 3) / unit, (0, 1), value=1.0),
            gap=(feet[:, 0] - feet[:, 1]).flatten(1, 2) / unit,
            weight=met.to(unit) / count[:, None],
            curvature=curvature_along(samples[..., 2], hit, seams.edge_lengths),
            corners=corners,
            corner_weight=torch.zeros_like(corners[..., 0]),
            prior_weight=prior,
        )
        # The error of a single height field, from the median distance of two.
        distance = mismatches(terms, transforms).norm(dim=-1).detach()[met]
        noise = torch.ones_like(unit)
        if len(distance):
            noise = distance.median().clamp_min(5e-3) / 2**0.5
        # An exact anchor has weight 1. Vertices that are not points of the cloud are inaccurate.
        exactness = noise.square() / (noise.square() + anchors.variance / unit.square())
        weight = torch.where(coarse.is_point[coarse.mesh.faces], exactness, 0.1) * anchors.valid
        return terms.replace(corner_weight=self.config.anchor * weight)

    def _solve_round(self, terms: AlignTerms, transforms: Transforms, fresh: bool) -> Transforms:
        touching = terms.facets[(terms.weight > 0).any(dim=1)].flatten()
        moves = torch.zeros_like(transforms[:, 0]).index_fill(0, touching, 1)
        terms = terms.replace(corner_weight=terms.corner_weight * moves[:, None])
        prior = terms.prior_weight.clone()
        prior[2] = torch.inf
        fixed_scales = terms.replace(prior_weight=prior)
        for solve in range(_REWEIGHTINGS if fresh else _REWEIGHTINGS - 1):
            distance = mismatches(terms, transforms).norm(dim=-1)
            square = (terms.weight * distance.square()).sum(dim=1)
            stiffness = seam_stiffness(terms.curvature, transforms[terms.facets, 2], square)
            # Tilts and shifts first: the mismatches that they remove do not depend on scales.
            problem = fixed_scales if fresh and solve == 0 else terms
            transforms = solve_transforms(problem, transforms, *stiffness)
            limited = _limit_scales(transforms, self.config.scale_limit)
            if not torch.equal(limited, transforms):
                transforms = solve_transforms(fixed_scales, limited, *stiffness)
        return transforms


def _limit_scales(transforms: Transforms, limit: float) -> Transforms:
    hx, hy, hz, h0 = transforms.unbind(dim=-1)
    return torch.stack([hx, hy, hz.clamp(1 / limit, limit), h0], dim=-1)


def _root_mean_square(terms: AlignTerms, transforms: Transforms) -> Scalar:
    square = mismatches(terms, transforms).square().sum(dim=-1)
    return average(square[terms.weight > 0]).sqrt()


def _apply(
    depths: DepthPatches, transforms: Transforms, status: Int[Tensor, " face"]
) -> tuple[Depths, ...]:
    buckets = []
    for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True):
        h = transforms[templates.facet]
        hx, hy, hz, h0 = h[:, :, None, None].unbind(dim=1)
        x, y, _ = templates.points_patch.double().unbind(dim=-1)
        depth = hx * x + hy * y + hz * height_field.depth.double() + h0
        # Composed, so that after a second alignment the transform is still from the first field.
        chained = h[:, 2:3] * height_field.transform + h * h.new_tensor([1, 1, 0, 1])
        buckets.append(
            height_field.replace(
                depth=depth.to(height_field.depth),
                transform=chained.to(height_field.transform),
                status=status[templates.facet],
            )
        )
    return tuple(buckets)
