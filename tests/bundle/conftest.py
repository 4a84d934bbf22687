from dataclasses import dataclass

import pytest
import torch
from torch.nn.functional import normalize

from pimper_torch.geometry.frames import invert_rigid, rotate, transform
from pimper_torch.patches.decompose import Decompose
from pimper_torch.patches.warp import Warp
from pimper_torch.photometry.harmonics import rotate_lights
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Convergence,
    Lens,
    Mesh,
    PatchSet,
    PhotometricPatches,
    Photometry,
    Views,
)
from pimper_torch.scenes.cameras import arc_cameras
from pimper_torch.scenes.lights import wandering_lights
from pimper_torch.scenes.meshes import icosphere
from pimper_torch.scenes.noise import random_speckle
from pimper_torch.scenes.render import render_shape
from pimper_torch.scenes.shapes import Sphere

VIEWS = 7


@dataclass(frozen=True, kw_only=True)
class Oracle:
    """A ball whose surface, light and albedo are known, photographed by known cameras."""

    views: Views
    cameras: Cameras
    patches: PatchSet
    photometry: PhotometricPatches
    lenses: tuple[Lens, ...]

    def seen(self, cameras):
        return Warp()(self.views, cameras, self.patches)


@pytest.fixture(scope="session")
def oracle():
    generator = torch.Generator().manual_seed(11)
    cameras = arc_cameras(
        VIEWS, width=160, height=120, focal_px=300.0, distance=3.5, span_deg=50.0, sway_deg=8.0
    )
    lamps = wandering_lights(
        VIEWS, generator, distance=5.0, spread_deg=35.0, least_tilt_deg=5.0, irradiance=0.6
    )
    texture = random_speckle(generator, cells=(0.3, 0.12, 0.06), contrast=1.5)
    lights = lamps.harmonics_world()
    scene = render_shape(Sphere(), cameras, lights, texture)
    vertices, faces = icosphere(2)
    faces = faces[(vertices[faces].mean(dim=1)[:, 2] > 0.6)]
    used, faces = torch.unique(faces, return_inverse=True)
    coarse = CoarseMesh(
        mesh=Mesh(vertices_world=vertices[used], faces=faces),
        reference=VIEWS // 2,
        is_point=torch.zeros(len(used), dtype=torch.bool),
    )
    patches = Decompose()(coarse, cameras)
    templates, photometry = zip(
        *(_true(bucket, lights, texture) for bucket in patches.buckets), strict=True
    )
    patches = patches.replace(buckets=templates)
    lens = Lens(camera=4, model="PINHOLE", params=(300.0, 300.0, 80.0, 60.0), width=160, height=120)
    return Oracle(
        views=scene.views,
        cameras=cameras,
        patches=patches,
        photometry=PhotometricPatches(patches=patches, buckets=photometry),
        lenses=(lens,) * VIEWS,
    )


def _true(templates, lights, texture):
    """Put a template on the ball, and say what is seen there."""
    frame = templates.patch_from_world
    center = frame[:, :3, 3]
    plane = templates.points_patch
    across = (plane[..., :2] - center[:, None, None, :2]).square().sum(dim=-1)
    inside = across < 0.9
    depth = center[:, 2, None, None] - (1 - across).clamp_min(0.1).sqrt()
    on = templates.replace(depth=depth, inside=templates.inside & inside)
    flat = on.points_patch.flatten(1, 2)
    points = transform(invert_rigid(frame), flat)
    normals = rotate(frame, normalize(points, dim=-1)).reshape(plane.shape)
    count = len(frame)
    return on, Photometry(
        normals_patch=normals,
        albedo=texture(points).reshape(plane.shape),
        lights_patch=rotate_lights(frame, lights.expand(count, -1, -1)),
        valid=on.inside,
        confidence=on.inside.to(depth),
        verdict=torch.zeros(count).long(),
        convergence=Convergence(
            iterations=torch.ones(count).long(),
            residual=torch.zeros(count),
            cause=torch.zeros(count).long(),
        ),
    )
