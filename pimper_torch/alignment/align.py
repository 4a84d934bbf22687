"""Alignment: bas-relief transforms that make neighbouring patches agree."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pimper_torch.alignment.overlaps import (
    Overlaps,
    Seams,
    find_seams,
    meet_overlaps,
    relief_at_corners,
    transformed,
)
from pimper_torch.alignment.system import (
    Pulls,
    curvature_along,
    mismatches,
    seam_stiffness,
    solve_transforms,
)
from pimper_torch.config import require
from pimper_torch.progress import report
from pimper_torch.records import DepthPatches, Depths

# An arc over an edge whose middle stands out by 0.7 % of its length has this C; flatter
# reliefs are not told apart.
_FLAT = 3e-3

# Vertices that were filled in between points of the cloud are guesses.
_FILLED_VERTEX = 0.1

# Reliefs this close, in edge lengths, agree; only beyond it can a sample be an outlier.
_SAME_PLACE = 5e-3

# Solves within one round, so that weights that depend on the answer settle.
_REWEIGHTINGS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignConfig:
    """How patches are brought together.

    Attributes:
        offset: Also let each patch move along its normal: 4 unknowns a patch instead of the
            published 3.
        curvature: Weight seams by the published ``k``; without it all weigh alike.
        rounds: How often the overlaps are met anew, as transformed so far, and solved.
        rows: Lines of samples across each overlap.
        columns: Samples along each line.
        reach_samples: Distance of the outermost lines from the edge, in template samples;
            about ``decompose.overlap_samples``.
        anchor: Weight of the facets' vertices, where the surface is known to pass, next to
            the agreement of a seam.
        prior: Weight that holds each transform at the identity. Where neighbours agree but
            for their scales, 1e-3 gives back three quarters of a wrong scale, 1e-4 all but
            4 %; where they agree in nothing, 1e-4 lets them be flattened.
        scale_limit: No relief is flattened or stretched by more than this factor.
        outlier: Samples that disagree by this many times the median lose three quarters of
            their weight, and quickly more beyond; depth edges run through some overlaps.
    """

    offset: bool = True
    curvature: bool = True
    rounds: int = 3
    rows: int = 5
    columns: int = 12
    reach_samples: float = 5.0
    anchor: float = 1.0
    prior: float = 3e-4
    scale_limit: float = 4.0
    outlier: float = 5.0

    def __post_init__(self) -> None:
        require(self.rounds >= 1, "rounds", self.rounds, "1 or more")
        require(self.rows >= 2, "rows", self.rows, "2 or more")
        require(self.columns >= 3, "columns", self.columns, "3 or more")
        require(self.reach_samples > 0, "reach_samples", self.reach_samples, "above 0")
        require(self.anchor >= 0, "anchor", self.anchor, "0 or more")
        require(self.prior > 0, "prior", self.prior, "above 0")
        require(self.scale_limit > 1, "scale_limit", self.scale_limit, "above 1")
        require(self.outlier > 0, "outlier", self.outlier, "above 0")


class Align(nn.Module):
    r"""Undo the bas-relief transform that photometry leaves each patch with.

    The relief z of a patch may still be changed to :math:`h^T S`, :math:`S = (x, y, z, 1)`
    in its own frame, without contradicting its photographs. All h are found together, from
    what neighbours say about the strip around the edge they share. Rays along the bisector
    of the two normals meet both reliefs, as transformed so far, and

    .. math::
        \min_h \sum_{seams} k \, \overline{| P_\mu + N_\mu h_\mu^T S_\mu
        - P_{\mu'} - N_{\mu'} h_{\mu'}^T S_{\mu'} |^2}

    with P the foot points on the facets' planes and N their normals. Each round meets the
    overlaps anew and solves one sparse linear system.

    *The curvature term.* :math:`k = 1 / \sum (C_\mu + C_{\mu'})` is read so: C is the mean
    square of the relief's curvature along the seam times the edge's length, under the
    current transform, so it grows as :math:`h_z^2`. Then :math:`k |r|^2` is a disagreement
    relative to the reliefs that disagree, and flattening both does not make it smaller. A
    linear solve holds k, and would not know; so the derivative of k enters the right-hand
    side of :math:`h_z`, as :math:`k^2 C h_z \overline{|r|^2}` from the previous solve. Where
    reliefs agree it vanishes.

    *Anchors.* Each relief is to pass through its facet's vertices, which are points of the
    sparse cloud, so the surface cannot slide or tilt; a weak prior toward the identity
    decides what nothing else does. A patch that meets no neighbour stays as it is.

    Rigid motions and the scale of the world change nothing. Differentiable in the depths
    through all rounds; which samples meet is constant.

    Source: Sabzevari, Del Bue, Murino: PiMPeR, 2015, for the system and k; offset, anchors,
    robust weights and rounds are ours.
    """

    def __init__(self, config: AlignConfig | None = None) -> None:
        super().__init__()
        self.config = config or AlignConfig()

    def forward(self, depths: DepthPatches) -> DepthPatches:
        """Align all patches.

        Returns:
            Changed depths with the transforms that changed them, and how far neighbours
            were apart before and after each round. Where no patch meets a neighbour, what
            came in.

        Raises:
            SingularSystemError: Depths that are not finite.
        """
        config, patches = self.config, depths.patches
        seams = find_seams(patches, config.rows, config.columns, config.reach_samples)
        if len(seams.facets) == 0:
            return depths
        unit = seams.edge_lengths.median()
        in_scene = torch.stack([torch.ones_like(unit)] * 3 + [unit])
        # h_0 is in units of the edge length here, so that no term of the system has a unit.
        transforms = unit.new_tensor([0, 0, 1, 0]).expand(patches.num_patches, 4)
        corners, known = relief_at_corners(patches, depths.buckets)
        anchors = _with_one(corners / unit), self._corner_weight(depths, known)
        apart = []
        for done in range(config.rounds):
            overlaps = meet_overlaps(seams, patches, depths.buckets, transforms * in_scene)
            if not bool(overlaps.met.any()):
                return depths
            pulls = self._pulls(anchors, seams, overlaps, unit)
            apart.append(_root_mean_square(pulls, transforms))
            transforms = self._solve_round(pulls, transforms, fresh=done == 0)
            report(done + 1, config.rounds)
        with torch.no_grad():
            overlaps = meet_overlaps(seams, patches, depths.buckets, transforms * in_scene)
            pulls = self._pulls(anchors, seams, overlaps, unit)
            mismatch = torch.stack([*apart, _root_mean_square(pulls, transforms)]) * unit
        return depths.replace(
            buckets=_apply(depths, transforms * in_scene),
            mismatch=mismatch.detach().to(depths.buckets[0].depth),
        )

    def _corner_weight(
        self, depths: DepthPatches, known: Bool[Tensor, "face 3"]
    ) -> Float[Tensor, "face 3"]:
        coarse = depths.patches.coarse
        certain = torch.where(coarse.is_point, 1.0, _FILLED_VERTEX)[coarse.mesh.faces]
        return self.config.anchor * certain.double() * known

    def _pulls(
        self,
        anchors: tuple[Float[Tensor, "face 3 4"], Float[Tensor, "face 3"]],
        seams: Seams,
        overlaps: Overlaps,
        unit: Float[Tensor, ""],
    ) -> Pulls:
        corners, corner_weight = anchors
        met = overlaps.met.flatten(1)
        touching = seams.facets[met.any(dim=1)]
        moves = torch.zeros_like(corner_weight).index_fill(0, touching.reshape(-1), 1)
        prior = torch.full_like(corners[0, :1, 0], self.config.prior).expand(4).clone()
        if not self.config.offset:
            prior[3] = torch.inf
        count = met.sum(dim=1).clamp_min(met.shape[1] // 4)  # thin evidence weighs less
        return Pulls(
            facets=seams.facets,
            normals=seams.normals,
            samples=_with_one(overlaps.samples.flatten(2, 3) / unit),
            gap=(overlaps.feet[:, 0] - overlaps.feet[:, 1]).flatten(1, 2) / unit,
            weight=met.to(corners) / count[:, None],
            curvature=curvature_along(overlaps.samples[..., 2], overlaps.met, seams.edge_lengths),
            corners=corners,
            corner_weight=corner_weight * moves,
            prior_weight=prior,
        )

    def _solve_round(
        self, pulls: Pulls, transforms: Float[Tensor, "face 4"], fresh: bool
    ) -> Float[Tensor, "face 4"]:
        for solve in range(_REWEIGHTINGS):
            distance = mismatches(pulls, transforms).norm(dim=-1)
            system = pulls
            # Before scales have been tried no disagreement is an outlier's fault.
            if not (fresh and solve < 2):
                trust = trust_by_distance(distance, pulls.weight > 0, self.config.outlier)
                system = pulls.replace(weight=pulls.weight * trust)
            terms = self._curvature_terms(system, transforms, distance)
            # What tilts and shifts can mend says nothing about scales.
            only_level = fresh and solve == 0
            transforms = solve_transforms(
                _with_scales_held(system) if only_level else system, transforms, *terms
            )
            limited = _limit_scales(transforms, self.config.scale_limit)
            if not torch.equal(limited, transforms):
                transforms = solve_transforms(_with_scales_held(system), limited, *terms)
        return transforms

    def _curvature_terms(
        self,
        pulls: Pulls,
        transforms: Float[Tensor, "face 4"],
        distance: Float[Tensor, "seam ray"],
    ) -> tuple[Float[Tensor, " seam"], Float[Tensor, "seam 2"]]:
        if not self.config.curvature:
            return torch.ones_like(distance[:, 0]), torch.zeros_like(pulls.curvature)
        scales = transforms[pulls.facets, 2]
        stiffness = seam_stiffness(pulls.curvature, scales, _FLAT)
        apart = (pulls.weight * distance.square()).sum(dim=1)
        return stiffness, (stiffness.square() * apart)[:, None] * pulls.curvature * scales


def _with_scales_held(pulls: Pulls) -> Pulls:
    held = pulls.prior_weight.clone()
    held[2] = torch.inf
    return pulls.replace(prior_weight=held)


def _limit_scales(transforms: Float[Tensor, "face 4"], limit: float) -> Float[Tensor, "face 4"]:
    hx, hy, hz, h0 = transforms.unbind(dim=-1)
    return torch.stack([hx, hy, hz.clamp(1 / limit, limit), h0], dim=-1)


def trust_by_distance(
    distance: Float[Tensor, "seam ray"], met: Bool[Tensor, "seam ray"], outlier: float
) -> Float[Tensor, "seam ray"]:
    """Weight samples down that are apart by far more than most.

    Args:
        distance: Between the two reliefs.
        met: Where it means something.
        outlier: A sample this many times the median apart keeps a quarter of its weight
            (Geman and McClure's function).
    """
    common = distance[met].median().clamp_min(_SAME_PLACE)
    return (1 + (distance / (outlier * common)).square()) ** -2


def _with_one(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    return torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)


def _root_mean_square(pulls: Pulls, transforms: Float[Tensor, "face 4"]) -> Float[Tensor, ""]:
    square = mismatches(pulls, transforms).square().sum(dim=-1)
    return square[pulls.weight > 0].mean().sqrt()


def _apply(depths: DepthPatches, transforms: Float[Tensor, "face 4"]) -> tuple[Depths, ...]:
    buckets = []
    for templates, relief in zip(depths.patches.buckets, depths.buckets, strict=True):
        own = transforms[templates.facet]
        depth = transformed(templates.points_patch.double(), relief.depth.double(), own)
        # Transforms chain: whoever aligns twice still learns the way from the first relief.
        chained = own[:, 2:3] * relief.transform + own * own.new_tensor([1, 1, 0, 1])
        buckets.append(
            relief.replace(depth=depth.to(relief.depth), transform=chained.to(relief.transform))
        )
    return tuple(buckets)
