"""The stage that finds heights by a sweep along normals, under the fitted light."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import Range, require, require_ranges
from pimper_torch.failures import over_patches, skipped_patches
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.ledger import leave_out
from pimper_torch.parallel import side_by_side
from pimper_torch.patches.pyramid import look_up
from pimper_torch.patches.sources import Sources, prepare
from pimper_torch.patches.transfer import transferred_normals
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Heights,
    Observations,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Record,
    SweptPatches,
    Templates,
    Views,
)
from pimper_torch.stage import Stage
from pimper_torch.sweep.consistency import inconsistency
from pimper_torch.sweep.costs import balanced_lights, compiled_costs
from pimper_torch.sweep.minimum import parabola_minimum, posterior_variance
from pimper_torch.sweep.selection import best_views, poses_first, view_scores
from pimper_torch.sweep.windows import level_weight, window_mean, window_size

# Samples whose noise is correlated, as they are interpolated between the same pixels: with 4 the
# claimed deviation of heights is 0.8 to 1.25 times that of their errors (`test_sweep.py`).
CORRELATED_SAMPLES = 4.0

# A sample seen at a flatter angle (cosine) is looked up as if seen at this one, 87 degrees: a
# choice.
_MIN_FACING = 0.05

# Least standard deviation of a patch's residuals, in units of saturation: for exact data.
MIN_SPREAD = 1e-4


# Samples of the template between heights that are tried, and in the standard deviation of the
# window that costs are averaged over: choices.
_STEP, _WINDOW = 0.7, 1.5

_NO_HEIGHTS = "These patches keep their template's heights there"

# Of the robust cost, in standard deviations of the patch's residuals: a choice (2.385 is 95 %
# efficient on Gaussian noise).
_LOSS_SCALE = 2.0

# Slope of the template off its facet, above which it is a cliff, where windows end: a choice.
_CLIFF = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Which heights are tried, and in how many views they are compared.

    Attributes:
        steps: Tried on each side of the template.
        num_views: Largest number of views that a sample is compared in: the best by angle,
            resolution and light of those that have it.
        min_views: A sample that fewer usable views have, of distinct poses, gets no height.
    """

    steps: Annotated[int, Range(least=1, most=1000)] = 4
    num_views: Annotated[int, Range(least=2, most=100_000)] = 16
    min_views: Annotated[int, Range(least=2)] = 3

    def __post_init__(self) -> None:
        require_ranges(self, "sweep")
        least = self.min_views
        require(self.num_views >= least, "sweep.num_views", self.num_views, "min_views or more")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Swept(Record):
    """The samples of a bucket that are swept, in a row.

    Attributes:
        index: In the flattened rasters.
        outward: Along which it is swept; unit, world.
        shading: Of albedo 1 in these.
        gains: Factors of radiance in these.
    """

    index: Int[Tensor, " sample"]
    patch: Int[Tensor, " sample"]
    points_world: Float[Tensor, "sample 3"]
    outward: Float[Tensor, "sample 3"]
    chosen: Int[Tensor, "sample chosen"]
    seen: Bool[Tensor, "sample chosen"]
    shading: Float[Tensor, "sample chosen"]
    gains: Float[Tensor, "sample chosen"]


class Sweep(Stage):
    r"""Find how far along the template's normal every sample has to move for views to agree.

    For each of a few heights all views are looked up again, and the light that was fitted, the
    photometric normal, or the coarse one where light determines none, and the best albedo predict
    them; robust residuals are averaged over a
    small window, which stops at cliffs and at the template's border, and the least cost is
    found to a fraction of a step. This is multi-view stereo under changing light. The inverse
    variance of a height follows from the costs of all heights: it is small with little texture,
    or where several heights have low costs. Depth that was guessed of the photographs chooses
    between these, and views that likely show no diffuse reflection of a sample are left out.

    A height at the end of the range is none. Differentiable in photographs, cameras, templates,
    normals, lights and the patches' residuals, offsets through the parabola at the least cost;
    which views and which height are chosen is constant.
    """

    def __init__(self, config: SweepConfig | None = None) -> None:
        super().__init__()
        self.config = config or SweepConfig()

    def forward(
        self,
        views: Views,
        cameras: Cameras,
        seen: PatchViews,
        photometric: PhotometricPatches,
        sources: Sources | None = None,
    ) -> SweptPatches:
        """Sweep all patches, or those of some buckets.

        Args:
            photometric: Light and normals of the same buckets.
            sources: The photographs as ``Warp`` prepares them; made here where not given.
        """
        buckets = zip(photometric.patches.buckets, seen.buckets, photometric.buckets, strict=True)
        coarse = photometric.patches.coarse
        one = partial(self._swept, cameras, sources or prepare(views), coarse, views.poses)
        return SweptPatches(
            photometric=photometric,
            buckets=tuple(side_by_side(one, list(buckets))),
            averaged=window_size(_WINDOW),
        )

    def _swept(
        self,
        cameras: Cameras,
        sources: Sources,
        coarse: CoarseMesh,
        poses: Int[Tensor, " view"] | None,
        bucket: tuple[Templates, Observations, Photometry],
    ) -> Heights:
        """Sweep a bucket; patches that cannot be have no heights."""
        templates = bucket[0]

        def lost(some: slice) -> Heights:
            zero = torch.zeros_like(templates.depth[some])
            none, priors = templates.facet.new_zeros(len(zero)), bucket[1].priors
            return Heights(
                offset=zero,
                information=zero,
                num_views=none,
                priors=None if priors is None else priors.take(some),
            )

        def work(some: slice) -> Heights:
            templates, registered, photometry = bucket
            part = templates.take(some), registered.take(some), photometry.take(some)
            return self._sweep(cameras, sources, coarse, poses, part)

        found = over_patches(work, templates.facet, "sweep", lost, _NO_HEIGHTS)
        usable = bucket[1].valid.sum(dim=1)
        most = (usable - self.config.num_views).clamp_min(0)
        leave_out("sweep.selection", int(most.sum()), total=int(usable.sum()))
        asked = usable >= self.config.min_views
        none = asked & (found.information == 0)
        leave_out("sweep.heights", int(none.sum()), total=int(asked.sum()))
        finite = found.offset.isfinite() & found.information.isfinite()
        if bool(finite.all()):
            return found
        lost_facets = templates.facet[~finite.flatten(1).all(dim=1)]
        skipped_patches("sweep", lost_facets, "heights are not finite", _NO_HEIGHTS)
        return found.replace(
            offset=torch.where(finite, found.offset, 0),
            information=torch.where(finite, found.information, 0),
        )

    def _sweep(
        self,
        cameras: Cameras,
        sources: Sources,
        coarse: CoarseMesh,
        poses: Int[Tensor, " view"] | None,
        bucket: tuple[Templates, Observations, Photometry],
    ) -> Heights:
        config = self.config
        templates, registered, photometry = bucket
        rows, cameras = templates.rows(cameras.num_views), templates.own(cameras)
        poses = None if poses is None else poses[rows]
        transferred = transferred_normals(coarse, templates)
        shown = registered.valid.flatten(2).any(dim=2).sum(dim=1)
        priors = registered.priors
        if priors is not None and priors.inlier is not None:
            registered = registered.replace(valid=registered.valid & (priors.inlier > 0.5))
        gray = sources.gray.finest
        fast = gray.dtype == torch.float32 and compiled_for(
            gray,
            cameras.cam_from_world,
            cameras.intrinsics,
            templates.depth,
            templates.patch_from_world,
            transferred,
            photometry.normals_patch,
            photometry.lights_patch,
            photometry.convergence.residual,
        )
        given = templates, registered, photometry, transferred, cameras, sources, rows, poses
        if fast:
            costs, swept = compiled_costs(
                *given,
                ladder=_STEP * self._ladder,
                scale=self._scale(photometry),
                num_views=config.num_views,
                min_views=config.min_views,
                min_facing=_MIN_FACING,
            )
        else:
            costs, swept = self._costs(*given)
        step = _STEP * templates.spacing
        window = level_weight(templates.depth.detach(), swept, templates.spacing, _CLIFF)
        averaged = window_size(_WINDOW)
        # Near zero Cauchy's loss is the square over twice its scale's: now over the variance.
        weight = _LOSS_SCALE**2 * averaged / CORRELATED_SAMPLES
        costs = weight * window_mean(costs, window, _WINDOW)
        weighed = window > 0
        costs = costs.movedim(1, -1)[weighed]
        guess: Float[Tensor, "sample hypothesis"] | None = None
        if priors is not None:
            # Where several heights agree, the guess chooses; photographs tell where it is.
            off = _STEP * templates.spacing[:, None, None, None] * self._ladder.to(costs)
            off = off - priors.offset[..., None]
            guess = torch.log1p(0.5 * priors.offset_information[..., None] * off.square())[weighed]
        position, curvature, found = parabola_minimum(costs, guess)
        variance = posterior_variance(costs, position, curvature)
        unknown = ((2 * config.steps + 1) ** 2 - 1) / 12  # the variance of not knowing
        fraction = (1 / variance - 1 / unknown).clamp_min(0) / averaged
        found = found & (fraction > 0)
        step = step[:, None, None].expand_as(window)[weighed]
        offset = torch.where(found, (position - config.steps) * step, 0)
        information = torch.where(found, fraction / step.square(), 0)
        none = torch.zeros_like(window)
        return Heights(
            offset=none.index_put((weighed,), offset),
            information=none.index_put((weighed,), information),
            num_views=shown,
            priors=priors,
        )

    @property
    def _ladder(self) -> Float[Tensor, " hypothesis"]:
        """Heights that are tried, in steps."""
        return torch.arange(-self.config.steps, self.config.steps + 1.0)

    def _scale(self, photometry: Photometry) -> Float[Tensor, " patch"]:
        """Return the residuals of each patch that count as large."""
        return _LOSS_SCALE * photometry.convergence.residual.clamp_min(MIN_SPREAD)

    def _costs(
        self,
        templates: Templates,
        registered: Observations,
        photometry: Photometry,
        transferred: Float[Tensor, "patch height width 3"],
        cameras: Cameras,
        sources: Sources,
        images: Int[Tensor, " view"],
        poses: Int[Tensor, " view"] | None,
    ) -> tuple[Float[Tensor, "patch hypothesis height width"], Float[Tensor, "patch height width"]]:
        """Return the cost of every height, and 1 where a sample is swept, else 0."""
        rows = self._rows(templates, registered, photometry, transferred, cameras, poses)
        step = _STEP * templates.spacing
        moves = step[rows.patch, None] * self._ladder.to(step)
        radiance = self._look_up(rows, templates, moves, cameras, sources, images)
        scale = self._scale(photometry)
        cost = inconsistency(radiance, rows.shading, rows.seen, scale[rows.patch])
        swept = torch.zeros_like(templates.depth).flatten().index_fill(0, rows.index, 1.0)
        return _spread_out(cost, rows.index, templates), swept.reshape(templates.depth.shape)

    def _rows(
        self,
        templates: Templates,
        registered: Observations,
        photometry: Photometry,
        transferred: Float[Tensor, "patch height width 3"],
        cameras: Cameras,
        poses: Int[Tensor, " view"] | None,
    ) -> _Swept:
        """List the samples that enough views have, with these."""
        config, views = self.config, cameras.num_views
        asked = photometry.observed & templates.inside
        asked = asked & (registered.valid.sum(dim=1) >= config.min_views)
        (index,) = torch.nonzero(asked.flatten(), as_tuple=True)
        patch = index // asked[0].numel()
        world_from_patch = invert_rigid(templates.patch_from_world)
        points = transform(world_from_patch, templates.points_patch.flatten(1, 2))
        outward = rotate(world_from_patch, transferred.flatten(1, 2))
        points, outward = points.reshape(-1, 3)[index], outward.reshape(-1, 3)[index]
        normals = photometry.normals_patch.reshape(-1, 3)[index]
        basis = torch.cat([torch.ones_like(normals[:, :1]), normals], dim=1)
        lights, gains = balanced_lights(photometry)
        shading = torch.einsum("sga,sa->sg", lights[patch], basis)
        valid = registered.valid.movedim(1, -1).reshape(-1, views)[index]
        with torch.no_grad():
            away = cameras.centers_world - points[:, None]
            facing = (normalize(away, dim=-1) * outward[:, None]).sum(dim=-1)
            footprint = self._footprint(points, templates.spacing[patch], cameras)
            score = view_scores(facing, footprint, shading)
            usable = valid & (facing > 0) & (shading > 0)
            if poses is not None:
                score = poses_first(score, usable, poses)
            chosen, seen = best_views(score, usable, config.num_views)
            enough = seen.sum(dim=1) >= config.min_views
            if poses is not None:
                enough = (seen & (score.gather(1, chosen) > 0)).sum(dim=1) >= config.min_views
        return _Swept(
            index=index[enough],
            patch=patch[enough],
            points_world=points[enough],
            outward=outward[enough],
            chosen=chosen[enough],
            seen=seen[enough],
            shading=shading.gather(1, chosen)[enough],
            gains=gains[patch].gather(1, chosen)[enough],
        )

    def _footprint(
        self,
        points: Float[Tensor, "sample 3"],
        spacing: Float[Tensor, " sample"],
        cameras: Cameras,
    ) -> Float[Tensor, "sample view"]:
        """Return the pixels that a sample would span in each view if it faced it."""
        focal = (cameras.intrinsics[:, 0, 0] * cameras.intrinsics[:, 1, 1]).sqrt()
        axes = cameras.cam_from_world[:, 2]
        depth = points @ axes[:, :3].mT + axes[:, 3]
        return spacing[:, None] * focal / depth.clamp_min(torch.finfo(depth.dtype).eps)

    def _look_up(
        self,
        rows: _Swept,
        templates: Templates,
        moves: Float[Tensor, "sample hypothesis"],
        cameras: Cameras,
        sources: Sources,
        images: Int[Tensor, " view"],
    ) -> Float[Tensor, "sample chosen hypothesis"]:
        """Look every sample up at all heights in its chosen views."""
        found = moves.new_zeros(*rows.chosen.shape, moves.shape[1]).flatten(0, 1)
        width = rows.chosen.shape[1]
        for view in range(cameras.num_views):
            (slot,) = torch.nonzero(((rows.chosen == view) & rows.seen).flatten(), as_tuple=True)
            if len(slot) == 0:
                continue
            sample = slot // width
            outward, start = rows.outward[sample], rows.points_world[sample]
            moved = start[:, None] + moves[sample, :, None] * outward[:, None]
            camera = cameras.cam_from_world[view], cameras.intrinsics[view]
            pixels, _ = project(moved.reshape(-1, 3), *camera)
            spacing = templates.spacing[rows.patch[sample]]
            one = cameras.take([view])
            across = self._footprint(start, spacing, one)[:, 0]
            away = normalize(one.centers_world - start, dim=-1)
            squeezed = (away * outward).sum(dim=-1).clamp_min(_MIN_FACING)
            level = (across * squeezed.sqrt()).clamp_min(1).log2()
            level = level[:, None].expand(-1, moves.shape[1]).flatten()
            radiance = look_up(sources.gray.levels(int(images[view])), pixels, level)
            found = found.index_copy(0, slot, radiance.reshape(len(slot), -1).to(found))
        return rows.gains[..., None] * found.reshape(*rows.chosen.shape, moves.shape[1])


def _spread_out(
    cost: Float[Tensor, "sample hypothesis"], index: Int[Tensor, " sample"], templates: Templates
) -> Float[Tensor, "patch hypothesis height width"]:
    """Put rows back on their rasters, zero elsewhere."""
    raster = templates.depth.shape
    flat = cost.new_zeros(templates.depth.numel(), cost.shape[1]).index_copy(0, index, cost)
    return flat.reshape(*raster, -1).movedim(-1, 1)
