"""Factorization of patches into albedo, normals and light."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pimper_torch.geometry.template_normals import transferred_normals
from pimper_torch.geometry.visibility import RayCaster, ray_caster
from pimper_torch.lighting.light_field import harmonics
from pimper_torch.linalg.robust import Cauchy, GemanMcClure, Huber, Loss, Squares
from pimper_torch.records import (
    CoarseMesh,
    Observations,
    PatchStatus,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Templates,
)
from pimper_torch.records.shapes import PatchVectors
from pimper_torch.runtime.config import require
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import recomputed
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.photometry.factor_priors import (
    FactorPrior,
    FieldLights,
    MapPriors,
    PriorTerms,
    SurfaceNormals,
)
from pimper_torch.stages.photometry.factor_problem import build_problem, patch_samples
from pimper_torch.stages.photometry.factor_solve import photometry_of, solve
from pimper_torch.stages.photometry.fit_light import Illumination, balanced
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig
from pimper_torch.stages.photometry.sample_estimates import (
    FlatSamples,
    exposed_lights,
    gather_samples,
    initial_shading,
)
from pimper_torch.stages.photometry.shadows import lit_samples
from pimper_torch.stages.photometry.status import light_varies, photometric_status
from pimper_torch.stages.stage import Stage

LOSSES: dict[str, Callable[..., Loss]] = {
    "squares": Squares,
    "cauchy": Cauchy,
    "huber": Huber,
    "geman-mcclure": GemanMcClure,
}


class Factorize(Stage):
    r"""Separate albedo, normals and light: ``J = L N`` with ``N`` on the photometric cone.

    Patches are factorized independently. The light field (:class:`FitLight
    <pimper_torch.stages.photometry.fit_light.FitLight>`) is the prior mean of their lights; colours
    and exposures of views are divided out first. Samples in shadow of the point light are excluded.
    If a patch in a lit room is mostly in shadow in a view, its lit samples are excluded instead.
    Each sample takes a last Gauss-Newton step, and albedo is fitted in every channel.

    Gauge: albedo and light share one free factor per scene, which :class:`FixGauge
    <pimper_torch.stages.photometry.gauge.FixGauge>` sets. With ``light_prior=0`` each patch also
    has a Lorentz ambiguity, which the initial values fix.

    Undetermined samples: those lit in fewer than ``min_views`` views, or with a normal that faces
    away, keep the coarse normal, are not ``valid`` and have information 0. Patches that light
    does not determine keep coarse normals, and their status is the cause (see
    :class:`~pimper_torch.records.PatchStatus`); a :class:`PimperWarning` counts them. The light
    of a view that does not see a patch is zero there. NaN and infinity in the radiance count as
    missing.

    Differentiable in the radiance and in the initial templates and normals: light field, lights
    and samples by the implicit function theorem at the optimum (see
    :mod:`~pimper_torch.stages.photometry.factor_gradients`), to which Newton's method converges
    if gradients are required. Constant: which samples are valid, colours and exposures of views,
    and a room's harmonics over its ambient light.
    """

    kept_as = PhotometricPatches

    def __init__(
        self, config: FactorizeConfig | None = None, priors: Sequence[nn.Module] | None = None
    ) -> None:
        super().__init__()
        self.config = config = config or FactorizeConfig()
        require(config.loss in LOSSES, "factorize.loss", config.loss, " or ".join(LOSSES))
        if priors is None:
            defaults = FieldLights(config.light_prior), SurfaceNormals(config.geometry_weight)
            priors = [*defaults, MapPriors()]
        for prior in priors:
            needed = "modules derived from FactorPrior"
            require(isinstance(prior, FactorPrior), "Factorize: priors", prior, needed)
        self.priors = nn.ModuleList(priors)

    def forward(self, seen: PatchViews, light: Illumination) -> PhotometricPatches:
        """Return albedo, normals and lights of patches.

        Args:
            seen: Samples of all patches, or of a few buckets.
            light: Result of :class:`~pimper_torch.stages.photometry.fit_light.FitLight`.

        Returns:
            Albedo and lights up to the factor of the scene, see
            :class:`~pimper_torch.stages.photometry.gauge.FixGauge`.
        """
        mesh = seen.patches.surface or seen.patches.coarse.mesh
        caster = ray_caster(mesh) if light.shadows else None
        buckets = list(zip(seen.patches.buckets, seen.buckets, strict=True))
        factorize = partial(self._factorized, seen.patches.coarse, light, caster)
        factorized = side_by_side(factorize, buckets)
        return PhotometricPatches(patches=seen.patches, buckets=tuple(factorized))

    def _factorized(
        self,
        coarse: CoarseMesh,
        light: Illumination,
        caster: RayCaster | None,
        bucket: tuple[Templates, Observations],
    ) -> Photometry:
        config, (templates, registered) = self.config, bucket
        light = light.replace(field=templates.own(light.field))
        registered = balanced(registered, light.field)
        normals = transferred_normals(coarse, templates)
        rows, status, lights = self._selected(templates, registered, normals, light, caster)
        gray, basis = rows.radiance.mean(dim=2), harmonics(rows.normals).mT
        shading = recomputed(initial_shading, gray, rows.seen, lights, basis)
        variance = light.guess_variance
        samples = patch_samples(rows, gray, lights, shading[:, 0], registered, variance)
        terms = [cast("PriorTerms", prior(samples)) for prior in self.priors]
        loss = LOSSES[config.loss](*([config.loss_scale] if config.loss_scale else []))
        undetermined = status != int(PatchStatus.DETERMINED)
        # 500 samples suffice for the residuals' deviation.
        stride = max(1, normals.shape[1] * normals.shape[2] // 512)
        problem = build_problem(samples, shading, terms, undetermined, loss, stride)
        factors, facets = solve(problem, config), templates.facet
        solved = photometry_of(problem, factors, rows, status, normals, facets, config.min_views)
        exposure = light.field.exposure
        if exposure is None:
            return solved
        exposure = exposure.to(solved.lights_patch).expand(len(facets), -1)
        lights = solved.lights_patch * exposure[..., None]
        return solved.replace(lights_patch=lights, exposure=exposure)

    def _selected(
        self,
        templates: Templates,
        registered: Observations,
        normals: PatchVectors,
        light: Illumination,
        caster: RayCaster | None,
    ) -> tuple[FlatSamples, Int[Tensor, " patch"], Float[Tensor, "patch view 4"]]:
        """Return the lit samples, the status of patches, and their first-order light.

        Shadows are excluded, as they would move over the surface like texture. They are kept if the
        light does not vary: then they are static on the surface.
        """
        least, variation = self.config.min_views, self.config.min_light_variation
        rows = gather_samples(templates, registered, normals)
        lit, lights = lit_samples(rows, templates, registered, normals, light.field, caster)
        dark = int((rows.seen & ~lit).sum())
        leave_out("photometry.shadows", dark, total=int(rows.seen.sum()))
        observed = (registered.valid & templates.inside[:, None]).flatten(1).any(dim=1)
        finite = rows.seen.flatten(1).any(dim=1)
        status = photometric_status(observed, finite, lit, lights, least, variation)
        undetermined = status != int(PatchStatus.DETERMINED)
        constant = undetermined & ~light_varies(lights, rows.seen.sum(dim=2), variation)
        rows = rows.only(lit | constant[:, None, None])
        exposed = recomputed(exposed_lights, rows, lights)
        return rows, status, torch.where(undetermined[:, None, None], exposed, lights)
