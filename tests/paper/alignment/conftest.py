import pytest
import torch
from scipy.spatial import Delaunay

from pimper_torch.ground.geometry.rigid import transform
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
from tests.paper.alignment.caps import CENTER, RADIUS, cap


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(7417)


@pytest.fixture
def facets_over(generator):
    """Facets between points of a surface z(x, y) over a jittered grid on [-1, 1]^2."""

    def build(height, side=5, sample=0.02, overlap=6.0):
        axis = torch.linspace(-1, 1, side, dtype=torch.float64)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        xy = torch.stack([x, y], dim=-1).reshape(-1, 2)
        inner = (xy.abs() < 0.999).all(dim=1, keepdim=True)
        jitter = torch.rand(xy.shape, generator=generator, dtype=torch.float64) - 0.5
        xy = xy + inner * jitter * 0.8 / side
        vertices = torch.cat([xy, height(xy[:, 0], xy[:, 1])[:, None]], dim=1)
        faces = torch.from_numpy(Delaunay(xy.numpy()).simplices).long()
        a, b, c = xy[faces].unbind(dim=1)
        rotation = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        # Outward is -z, toward the camera: clockwise in (x right, y down).
        faces = torch.where((rotation > 0)[:, None], faces[:, [0, 2, 1]], faces)
        faces = faces[rotation.abs() > 1e-6]
        cam_from_world = torch.eye(4, dtype=torch.float64)[None].clone()
        cam_from_world[0, 2, 3] = 10.0
        focal = 10.0 / sample
        intrinsics = torch.tensor([[focal, 0, 0], [0, focal, 0], [0, 0, 1]], dtype=torch.float64)
        cameras = Cameras(
            intrinsics=intrinsics[None],
            cam_from_world=cam_from_world,
            sizes_px=torch.tensor([[100, 100]]),
        )
        coarse = CoarseMesh(
            mesh=Mesh(vertices_world=vertices, faces=faces),
            reference=0,
            is_point=torch.ones(len(vertices), dtype=torch.bool),
        )
        return Decompose(DecomposeConfig(overlap_samples=overlap))(coarse, cameras)

    return build


@pytest.fixture
def height_fields():
    """Give patches a height field, ``(points_patch, patch_from_world) -> depth``."""

    def build(patches, height_field):
        buckets, facing = [], torch.tensor([0.0, 0, -1])
        for templates in patches.buckets:
            depth = height_field(templates.points_patch, templates.patch_from_world)
            identity = torch.tensor([0.0, 0, 1, 0], dtype=depth.dtype).expand(len(depth), 4)
            buckets.append(Depths(depth=depth, valid=templates.inside, transform=identity))
        normals = [facing.expand(*one.depth.shape, 3) for one in patches.buckets]
        photometric = PhotometricPatches.of(patches, normals=normals, lights=torch.ones(1, 4))
        return DepthPatches(photometric=photometric, buckets=tuple(buckets))

    return build


@pytest.fixture
def sphere_height_field():
    """Closed form: the near side of a sphere, seen along each patch's z."""

    def build(center, radius):
        def height_field(points, patch_from_world):
            center_patch = transform(patch_from_world, center[None])[:, None]
            x, y, _ = (points - center_patch).unbind(dim=-1)
            return center_patch[..., 2] - (radius**2 - x**2 - y**2).sqrt()

        return height_field

    return build


@pytest.fixture
def sphere(facets_over, height_fields, sphere_height_field):
    return height_fields(facets_over(cap), sphere_height_field(CENTER, RADIUS))
