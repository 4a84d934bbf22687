from dataclasses import dataclass

import pytest
import torch

from pimper_torch.geometry.frames import rotate
from pimper_torch.patches.decompose import Decompose, DecomposeConfig
from pimper_torch.patches.warp import Warp
from pimper_torch.photometry.harmonics import rotate_lights
from pimper_torch.records import (
    CoarseMesh,
    Convergence,
    Mesh,
    PatchViews,
    PhotometricPatches,
    Photometry,
)
from pimper_torch.scenes import RenderedScene, render_shape
from pimper_torch.scenes.cameras import arc_cameras
from pimper_torch.scenes.lights import wandering_lights
from pimper_torch.scenes.noise import random_speckle
from pimper_torch.scenes.shapes import Plane

NORMAL = (0.15, -0.1, 1.0)


@dataclass(frozen=True)
class Lifted:
    """A photographed plane, facets above or below it, and what is known of its light."""

    scene: RenderedScene
    seen: PatchViews
    photometric: PhotometricPatches
    height: float


@pytest.fixture(scope="session")
def lift():
    """Facets ``height`` samples outside a plane; texture, or one albedo all over."""

    def make(height: float, textured: bool = True) -> Lifted:
        generator = torch.Generator().manual_seed(64)
        cameras = arc_cameras(9, width=120, height=90, focal_px=330.0, distance=3.0, span_deg=50.0)
        lamps = wandering_lights(
            9, generator, distance=5.0, spread_deg=35.0, least_tilt_deg=5.0, irradiance=0.6
        )
        speckle = random_speckle(generator, cells=(0.12, 0.05), contrast=1.0)

        def bare(points: torch.Tensor) -> torch.Tensor:
            return torch.full_like(points, 0.5)

        texture = speckle if textured else bare
        scene = render_shape(Plane(normal=NORMAL), cameras, lamps.harmonics_world(), texture)
        normal = torch.tensor(NORMAL, dtype=torch.float64)
        normal = normal / normal.norm()
        xy = torch.tensor([[-0.3, -0.25], [0.3, -0.25], [0.3, 0.25], [-0.3, 0.25]]).double()
        flat = torch.cat([xy, -(xy @ normal[:2, None]) / normal[2]], dim=1)
        spacing = 3.0 / 330.0
        mesh = Mesh(
            vertices_world=flat + height * spacing * normal,
            faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
        )
        coarse = CoarseMesh(mesh=mesh, reference=4, is_point=torch.ones(4, dtype=torch.bool))
        # The arc looks from +z, so the facets must be wound to face it.
        patches = Decompose(DecomposeConfig(overlap_samples=2.0))(coarse, cameras)
        seen = Warp()(scene.views, cameras, patches)
        buckets = []
        for templates in patches.buckets:
            shape = templates.depth.shape
            turned = rotate(templates.patch_from_world, normal.expand(len(templates.facet), 1, 3))
            count = len(templates.facet)
            buckets.append(
                Photometry(
                    normals_patch=turned[:, :, None].expand(*shape, 3),
                    albedo=torch.ones(*shape, 3).double(),
                    lights_patch=rotate_lights(templates.patch_from_world, scene.lights_world),
                    valid=templates.inside,
                    confidence=torch.full(shape, 0.9, dtype=torch.float64),
                    verdict=torch.zeros(count, dtype=torch.long),
                    convergence=Convergence(
                        iterations=torch.ones(count, dtype=torch.long),
                        residual=torch.full((count,), 0.005, dtype=torch.float64),
                        cause=torch.zeros(count, dtype=torch.long),
                    ),
                )
            )
        photometric = PhotometricPatches(patches=patches, buckets=tuple(buckets))
        return Lifted(
            scene=scene,
            seen=seen,
            photometric=photometric,
            height=height
            * float(patches.buckets[0].spacing[0] / spacing)
            * spacing
            / float(patches.buckets[0].spacing[0]),
        )

    return make
