"""The stage that finds heights by a sweep along normals, under the fitted light."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.pyramids import Sources, prepare
from pimper_torch.ground.geometry.template_normals import transferred_normals
from pimper_torch.method.sweep.costs import STEP, Hypotheses, costs_of
from pimper_torch.method.sweep.minimum import parabola_minimum, posterior_variance
from pimper_torch.method.sweep.sweep_config import SweepConfig
from pimper_torch.method.sweep.windows import level_weight, window_mean, window_size
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
from pimper_torch.runtime.stage import Stage

# Samples whose noise is correlated, as they are interpolated between the same pixels: with 4 the
# claimed deviation of heights is 0.8 to 1.25 times that of their errors (`test_sweep.py`).
CORRELATED_SAMPLES = 4.0

# Standard deviation of the window that costs are averaged over, in samples: a choice.
_WINDOW = 1.5

# Of the robust cost, in standard deviations of the patch's residuals: a choice (2.385 is 95 %
# efficient on Gaussian noise).
_LOSS_SCALE = 2.0


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
        pictures, coarse = sources or prepare(views), photometric.patches.coarse

        def one(bucket: tuple[Templates, Observations, Photometry]) -> Heights:
            found = self._sweep(cameras, pictures, coarse, views.poses, *bucket)
            return self._finite(found, *bucket[:2])

        return SweptPatches(
            photometric=photometric,
            buckets=tuple(side_by_side(one, list(buckets))),
            averaged=window_size(_WINDOW),
        )

    def _finite(self, found: Heights, templates: Templates, registered: Observations) -> Heights:
        """Drop heights that are not finite, and record how many samples have none."""
        usable = registered.valid.sum(dim=1)
        most = (usable - self.config.num_views).clamp_min(0)
        leave_out("sweep.selection", int(most.sum()), total=int(usable.sum()))
        asked = usable >= self.config.min_views
        none = asked & (found.information == 0)
        leave_out("sweep.heights", int(none.sum()), total=int(asked.sum()))
        finite = found.offset.isfinite() & found.information.isfinite()
        if bool(finite.all()):
            return found
        lost = templates.facet[~finite.flatten(1).all(dim=1)]
        done = "These patches keep their template's heights there"
        skipped_patches("sweep", lost, "heights are not finite", done)
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
        templates: Templates,
        registered: Observations,
        photometry: Photometry,
    ) -> Heights:
        config = self.config
        images = templates.rows(cameras.num_views)
        shown = registered.valid.flatten(2).any(dim=2).sum(dim=1)
        priors = registered.priors
        if priors is not None and priors.inlier is not None:
            registered = registered.replace(valid=registered.valid & (priors.inlier > 0.5))
        # On exact data residuals are rounding.
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
        window = level_weight(templates.depth.detach(), swept, templates.spacing)
        averaged = window_size(_WINDOW)
        # Near zero Cauchy's loss is the square over twice its scale's: now over the variance.
        weight = _LOSS_SCALE**2 * averaged / CORRELATED_SAMPLES
        costs = weight * window_mean(costs, window, _WINDOW)
        weighed = window > 0
        costs = costs.movedim(1, -1)[weighed]
        guess: Float[Tensor, "sample hypothesis"] | None = None
        if priors is not None:
            # Where several heights agree, the guess chooses; photographs show where it is.
            off = STEP * templates.spacing[:, None, None, None] * ladder.to(costs)
            off = off - priors.offset[..., None]
            guess = torch.log1p(0.5 * priors.offset_information[..., None] * off.square())[weighed]
        position, curvature, interior = parabola_minimum(costs, guess)
        variance = posterior_variance(costs, position, curvature)
        unknown = ((2 * config.steps + 1) ** 2 - 1) / 12  # the variance of not knowing
        fraction = (1 / variance - 1 / unknown).clamp_min(0) / averaged
        interior = interior & (fraction > 0)
        step = (STEP * templates.spacing)[:, None, None].expand_as(window)[weighed]
        offset = torch.where(interior, (position - config.steps) * step, 0)
        information = torch.where(interior, fraction / step.square(), 0)
        zero = torch.zeros_like(window)
        return Heights(
            offset=zero.index_put((weighed,), offset),
            information=zero.index_put((weighed,), information),
            num_views=shown,
            priors=priors,
        )
