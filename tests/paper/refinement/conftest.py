"""Patches with closed-form height field on small coarse meshes."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from scipy.spatial import Delaunay
from torch import Tensor

from pimper_torch.ground.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.ground.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.method.patches.decompose import Decompose
from pimper_torch.method.patches.patches_config import DecomposeConfig
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    DepthPatches,
    Depths,
    Mesh,
    PhotometricPatches,
)

# Relief along z of the world as a function of x and y: closed forms seen from -z.
Height = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Builder:
    """Coarse meshes under a height field z(x, y), and exact patches on them."""

    def coarse(self, height: Height, rings: int = 2, radius: float = 0.6) -> CoarseMesh:
        places = [torch.zeros(1, 2, dtype=torch.float64)]
        for ring in range(1, rings + 1):
            angle = torch.arange(6 * ring, dtype=torch.float64) * (2 * torch.pi / (6 * ring))
            place = torch.stack([(angle + 0.3).cos(), (angle + 0.3).sin()], dim=1)
            places.append(radius * ring / rings * place)
        xy = torch.cat(places)
        faces = torch.tensor(Delaunay(xy.numpy()).simplices).long()
        vertices = torch.cat([xy, height(xy[:, 0], xy[:, 1])[:, None]], dim=1)
        rotated = face_normals(vertices, faces)[:, 2] > 0
        faces = torch.where(rotated[:, None], faces.flip(1), faces)
        normals = vertex_normals(vertices, faces)
        mesh = Mesh(vertices_world=vertices, faces=faces, normals_world=normals)
        return CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(len(xy), dtype=torch.bool))

    def patches(
        self, coarse: CoarseMesh, height: Height, spacing: float = 0.02, overlap: float = 6.0
    ) -> DepthPatches:
        eye = torch.eye(4, dtype=torch.float64)[None].clone()
        eye[0, 2, 3] = 4
        intrinsics = torch.tensor([[[4 / spacing, 0, 50], [0, 4 / spacing, 50], [0, 0, 1]]])
        cameras = Cameras(
            intrinsics=intrinsics.double(),
            cam_from_world=eye,
            sizes_px=torch.tensor([[100, 100]]),
        )
        depth = coarse.mesh.vertices_world[:, 2].median() + 4
        intrinsics[:, :2, :2] *= depth / 4
        cameras = cameras.replace(intrinsics=intrinsics.double())
        config = DecomposeConfig(overlap_samples=overlap, bucket_entries=20_000)
        patches = Decompose(config)(coarse, cameras)
        depths, normals, albedo = zip(
            *(_exact(templates, height) for templates in patches.buckets), strict=True
        )
        photometric = PhotometricPatches.of(
            patches, normals=normals, albedo=albedo, lights=torch.zeros(1, 4), information=1e3
        )
        return DepthPatches(photometric=photometric, buckets=depths)


def _exact(templates, height):
    """Newton along the patch's z for the height field; normals by autograd."""
    world_from_patch = invert_rigid(templates.patch_from_world)
    flat = templates.points_patch.flatten(1, 2)
    depth = torch.zeros_like(flat[..., 2])

    def gap(z):
        points = torch.cat([flat[..., :2], z[..., None]], dim=-1)
        x, y, up = transform(world_from_patch, points).unbind(dim=-1)
        return up - height(x, y)

    for _ in range(30):
        with torch.enable_grad():
            z = depth.detach().requires_grad_()
            value = gap(z)
            (rate,) = torch.autograd.grad(value.sum(), z)
        depth = depth - value.detach() / rate
    points = torch.cat([flat[..., :2], depth[..., None]], dim=-1)
    with torch.enable_grad():
        world = transform(world_from_patch, points).requires_grad_()
        (slope,) = torch.autograd.grad(
            (world[..., 2] - height(world[..., 0], world[..., 1])).sum(), world
        )
    shape = templates.depth.shape
    exact = depth.isfinite().reshape(shape) & templates.inside
    identity = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64).expand(shape[0], 4)
    depth = torch.where(exact, depth.reshape(shape), 0)
    normals = rotate(templates.patch_from_world, -slope).reshape(*shape, 3)
    albedo = (0.5 + 0.25 * world.detach()).reshape(*shape, 3)
    return Depths(depth=depth, valid=exact, transform=identity), normals, albedo


@pytest.fixture(scope="session")
def builder() -> Builder:
    return Builder()


def ball(x: Tensor, y: Tensor) -> Tensor:
    """The near side of the unit sphere round (0, 0, 1)."""
    return 1 - (1 - x.square() - y.square()).clamp_min(1e-3).sqrt()


@pytest.fixture(scope="session")
def cap(builder: Builder) -> DepthPatches:
    """A cap of the unit sphere round (0, 0, 1), 40 degrees to each side, exact height field."""
    coarse = builder.coarse(ball)
    return builder.patches(coarse, ball)
