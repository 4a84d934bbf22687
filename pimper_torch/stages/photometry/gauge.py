"""The scale between albedo and lights, one factor for the scene."""

import math

import torch

from pimper_torch.records import PatchStatus, PhotometricPatches
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig
from pimper_torch.stages.photometry.status import warn_of_undetermined
from pimper_torch.stages.stage import Stage


class FixGauge(Stage):
    """Set the 99th percentile of gray albedo to 1, over all patches.

    It is the percentile of the samples with photometric normals, or of all observed samples if
    there are none. Warns of patches without photometric normals. Differentiable.

    Args:
        config: Settings of the factorization; the warning names its limits.
    """

    def __init__(self, config: FactorizeConfig | None = None) -> None:
        super().__init__()
        self.config = config or FactorizeConfig()

    def forward(self, solved: PhotometricPatches) -> PhotometricPatches:
        """Return all patches, with albedo divided by the percentile and lights multiplied by it."""
        config = self.config
        status = torch.cat([bucket.status for bucket in solved.buckets])
        mesh, facets = solved.patches.coarse.mesh, [x.facet for x in solved.patches.buckets]
        undetermined = status != int(PatchStatus.DETERMINED)
        triangles = mesh.vertices_world, mesh.faces[torch.cat(facets)]
        leave_out("photometry.undetermined", undetermined, at=triangles)
        warn_of_undetermined(solved.buckets, config.min_views, config.min_light_variation)
        determined = any(bool(bucket.valid.any()) for bucket in solved.buckets)
        gray = [
            bucket.albedo.mean(dim=-1)[bucket.valid if determined else bucket.observed]
            for bucket in solved.buckets
        ]
        count = sum(map(len, gray))
        if count == 0:
            return solved
        bright = torch.cat(gray).kthvalue(max(1, math.ceil(0.99 * count))).values
        factor = torch.where(bright > 0, bright, 1)
        buckets = tuple(
            bucket.replace(albedo=bucket.albedo / factor, lights_patch=bucket.lights_patch * factor)
            for bucket in solved.buckets
        )
        return solved.replace(buckets=buckets)
