"""The stage that estimates heights by a sweep along normals, under the fitted light."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.pyramids import Sources, build_pyramids
from pimper_torch.geometry.template_normals import transferred_normals
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Heights,
    Observations,
    PatchViews,
    PhotometricPatches,
    Photometry,
    SweptPatches,
    Templates,
    Views,
)
from pimper_torch.runtime.failures import skipped_patches
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.stage import Stage
from pimper_torch.stages.sweep.costs import STEP, Hypotheses, costs_of
from pimper_torch.stages.sweep.minimum import parabola_minimum, posterior_variance
from pimper_torch.stages.sweep.sweep_config import SweepConfig
from pimper_torch.stages.sweep.windows import flat_weight, window_mean, window_size

# Number of samples with common noise, because they are interpolated between the same pixels: with 4
# the estimated standard error of heights is 0.8 to 1.25 times the actual one (`test_sweep.py`).
CORRELATED_SAMPLES = 4.0

# Standard deviation of the window over which costs are averaged, in samples. A choice.
_WINDOW = 1.5

# Scale of the robust cost, in standard deviations of the patch's residuals. A choice (2.385 is 95 %
# efficient on Gaussian noise).
_LOSS_SCALE = 2.0


class Sweep(Stage):
    r"""Estimate the height of every sample, along the template's normal, at which views agree.

    At each of a few heights all views are sampled, and their radiance is predicted from the fitted
    light, the photometric normal (the coarse one if light determines none) and the best albedo.
    Robust residuals are averaged over a small window that stops at cliffs and at the template's
    border, and the minimum is located to a fraction of a step. This is multi-view stereo under
    changing light. The inverse variance of a height follows from the costs of all heights: it is
    small with little texture, or if several heights have low costs. A depth prior selects between
    these, and views that likely show no diffuse reflection of a sample are excluded.

    A minimum at the end of the range gives no height. Differentiable in photographs, cameras,
    templates, normals, lights and the patches' residuals; offsets through the parabola at the least
    cost. The selected views and heights are constant.
    """

    kept_as = SweptPatches

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
        """Return the heights of all patches.

        Args:
            photometric: Lights and normals of the same buckets.
            sources: Image pyramids of the photographs, as for ``Warp``; computed if not given.
        """
        buckets = zip(photometric.patches.buckets, seen.buckets, photometric.buckets, strict=True)
        pyramids, coarse = sources or build_pyramids(views), photometric.patches.coarse

        def of_bucket(bucket: tuple[Templates, Observations, Photometry]) -> Heights:
            heights = self._sweep(cameras, pyramids, coarse, views.poses, *bucket)
            return self._finite(heights, *bucket[:2])

        return SweptPatches(
            photometric=photometric,
            buckets=tuple(side_by_side(of_bucket, list(buckets))),
            averaged=window_size(_WINDOW),
        )

    def _finite(self, heights: Heights, templates: Templates, registered: Observations) -> Heights:
        """Return the finite heights, and record the number of samples without height."""
        usable = registered.valid.sum(dim=1)
        surplus = (usable - self.config.num_views).clamp_min(0)
        leave_out("sweep.selection", int(surplus.sum()), total=int(usable.sum()))
        swept = usable >= self.config.min_views
        missing = swept & (heights.information == 0)
        leave_out("sweep.heights", int(missing.sum()), total=int(swept.sum()))
        finite = heights.offset.isfinite() & heights.information.isfinite()
        if bool(finite.all()):
            return heights
        facets = templates.facet[~finite.flatten(1).all(dim=1)]
        done = "These patches keep their template's heights there"
        skipped_patches("sweep", facets, "heights are not finite", done)
        return heights.replace(
            offset=torch.where(finite, heights.offset, 0),
            information=torch.where(finite, heights.information, 0),
        )

    def _sweep(
        self,
        cameras: Cameras,
        sources: Sources,
        coarse: CoarseMesh,
        poses: Int[Tensor, " view"] | None,
        templates: Templates,
        registered: Observations,
        photometry: Photometry,
    ) -> Heights:
        config = self.config
        images = templates.rows(cameras.num_views)
        num_views = registered.valid.flatten(2).any(dim=2).sum(dim=1)
        priors = registered.priors
        if priors is not None and priors.inlier is not None:
            registered = registered.replace(valid=registered.valid & (priors.inlier > 0.5))
        # On exact data, residuals are only rounding errors.
        residual = photometry.convergence.residual.clamp_min(1e-4)
        ladder = torch.arange(-config.steps, config.steps + 1.0)
        hypotheses = Hypotheses(
            templates=templates,
            registered=registered,
            photometry=photometry,
            outward=transferred_normals(coarse, templates),
            cameras=templates.own(cameras),
            sources=sources,
            images=images,
            poses=None if poses is None else poses[images],
            ladder=ladder,
            scale=_LOSS_SCALE * residual,
        )
        costs, swept = costs_of(hypotheses, config.num_views, config.min_views)
        window = flat_weight(templates.depth.detach(), swept, templates.spacing)
        averaged = window_size(_WINDOW)
        # Near zero Cauchy's loss is the square over twice the squared scale: now over the variance.
        weight = _LOSS_SCALE**2 * averaged / CORRELATED_SAMPLES
        costs = weight * window_mean(costs, window, _WINDOW)
        inside = window > 0
        costs = costs.movedim(1, -1)[inside]
        prior: Float[Tensor, "sample hypothesis"] | None = None
        if priors is not None:
            # The prior selects among heights of low cost; costs alone locate the minimum.
            error = STEP * templates.spacing[:, None, None, None] * ladder.to(costs)
            error = error - priors.offset[..., None]
            prior = torch.log1p(0.5 * priors.offset_information[..., None] * error.square())[inside]
        position, curvature, interior = parabola_minimum(costs, prior)
        variance = posterior_variance(costs, position, curvature)
        uniform = ((2 * config.steps + 1) ** 2 - 1) / 12  # variance of equal costs
        fraction = (1 / variance - 1 / uniform).clamp_min(0) / averaged
        interior = interior & (fraction > 0)
        step = (STEP * templates.spacing)[:, None, None].expand_as(window)[inside]
        offset = torch.where(interior, (position - config.steps) * step, 0)
        information = torch.where(interior, fraction / step.square(), 0)
        zero = torch.zeros_like(window)
        return Heights(
            offset=zero.index_put((inside,), offset),
            information=zero.index_put((inside,), information),
            num_views=num_views,
            priors=priors,
        )
