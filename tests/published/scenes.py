"""Patches over closed-form surfaces seen from -z, and changes of their height fields."""

import torch
from torch.nn.functional import normalize

import pimper_torch as pt
from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.paper.cloud_filters import delaunay
from pimper_torch.records import Depths
from pimper_torch.stages.patches.patches_config import DecomposeConfig

IDENTITY = torch.tensor([0.0, 0, 1, 0], dtype=torch.float64)


def grid(generator, side=5):
    """A jittered grid on [-1, 1]^2."""
    axis = torch.linspace(-1, 1, side, dtype=torch.float64)
    xy = torch.cartesian_prod(axis, axis).flip(1)
    jitter = torch.rand(xy.shape, generator=generator, dtype=torch.float64) - 0.5
    return xy + (xy.abs() < 0.999).all(dim=1, keepdim=True) * jitter * 0.8 / side


def rings(count=2, radius=0.6):
    """Hexagons around the origin."""
    places = [torch.zeros(1, 2, dtype=torch.float64)]
    for ring in range(1, count + 1):
        angle = torch.arange(6 * ring, dtype=torch.float64) * (torch.pi / (3 * ring)) + 0.3
        places.append(radius * ring / count * torch.stack([angle.cos(), angle.sin()], dim=1))
    return torch.cat(places)


def facets_over(height, xy, sample=0.02, overlap=6.0, dtype=torch.float64):
    """Decompose facets between points of a surface z(x, y), seen by a camera at z = -10."""
    vertices = torch.cat([xy, height(xy[:, 0], xy[:, 1])[:, None]], dim=1).to(dtype)
    faces = delaunay(xy)
    edges = xy[faces[:, 1:]] - xy[faces[:, :1]]
    faces = faces[torch.linalg.det(edges).abs() > 1e-6]
    cam_from_world = torch.eye(4, dtype=dtype)[None].clone()
    cam_from_world[0, 2, 3] = 10.0
    focal = (10 + vertices[:, 2].median()) / sample
    cameras = pt.Cameras(
        intrinsics=torch.diag(torch.tensor([focal, focal, 1.0], dtype=dtype))[None],
        cam_from_world=cam_from_world,
        sizes_px=torch.tensor([[100, 100]]),
    )
    mesh = pt.Mesh(
        vertices_world=vertices, faces=faces, normals_world=vertex_normals(vertices, faces)
    )
    coarse = pt.CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(len(xy), dtype=torch.bool))
    return pt.Decompose(DecomposeConfig(overlap_samples=overlap))(coarse, cameras)


def height_fields(patches, height_field):
    """Give patches a height field, ``(points_patch, patch_from_world) -> depth``, and its normals.

    Albedo is affine in the position in the world.
    """
    buckets, normals, albedo = [], [], []
    for templates in patches.buckets:
        points = templates.points_patch.clone().requires_grad_()
        depth = height_field(points, templates.patch_from_world)
        (slope,) = torch.autograd.grad(depth.sum(), points)
        normals.append(normalize(slope - slope.new_tensor([0, 0, 1]), dim=-1))
        valid = templates.inside & depth.isfinite()
        depth = torch.where(valid, depth, 0).detach()
        surface = torch.cat([templates.points_patch[..., :2], depth[..., None]], dim=-1)
        world = transform(invert_rigid(templates.patch_from_world), surface.flatten(1, 2))
        albedo.append(0.5 + 0.25 * world.reshape(surface.shape))
        identity = IDENTITY.expand(len(depth), 4)
        buckets.append(Depths(depth=depth, valid=valid, transform=identity))
    photometric = pt.PhotometricPatches.of(
        patches, normals=normals, albedo=albedo, lights=torch.ones(1, 4), information=1e3
    )
    return pt.DepthPatches(photometric=photometric, buckets=tuple(buckets))


def level(points, _):
    """The zero height field of coplanar facets."""
    return 0 * points[..., 0]


def ball(radius):
    """The near side of a sphere that touches the origin, as z(x, y) and on patches."""

    def height(x, y):
        return radius - (radius**2 - x**2 - y**2).sqrt()

    def height_field(points, patch_from_world):
        center = transform(patch_from_world, points.new_tensor([[0, 0, radius]]))[:, None]
        x, y, _ = (points - center).unbind(dim=-1)
        return center[..., 2] - (radius**2 - x**2 - y**2).sqrt()

    return height, height_field


def changed(depths, change):
    """Replace fields of every bucket by ``change(templates, height field)``."""
    pairs = zip(depths.patches.buckets, depths.buckets, strict=True)
    buckets = tuple(field.replace(**change(templates, field)) for templates, field in pairs)
    return depths.replace(buckets=buckets)


def random_transforms(count, generator):
    draw = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    tilt, scale = 0.15 * draw[:, :2], (0.35 * draw[:, 2:]).exp()
    return torch.cat([tilt, scale, torch.zeros_like(scale)], dim=1)


def spoiled(depths, transforms):
    def change(templates, field):
        hx, hy, hz, h0 = transforms[templates.facet][:, :, None, None].unbind(dim=1)
        x, y, _ = templates.points_patch.unbind(dim=-1)
        return {"depth": hx * x + hy * y + hz * field.depth + h0}

    return changed(depths, change)


def waves(depths, amplitude, generator):
    """Add individual waves, a quarter of an edge long, to every patch."""

    def change(templates, field):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        depth = field.depth
        for _ in range(6):
            fx, fy, start = torch.randn(3, len(x), 1, 1, generator=generator, dtype=torch.float64)
            wave = torch.cos(fx / 0.08 * x + fy / 0.08 * y + 9 * start)
            depth = depth + amplitude / 3**0.5 * wave
        return {"depth": depth}

    return changed(depths, change)


def by_facet(depths):
    """Return the transforms in the order of the facets."""
    facets = torch.cat([templates.facet for templates in depths.patches.buckets])
    transforms = torch.cat([height_field.transform for height_field in depths.buckets])
    return transforms[torch.argsort(facets)]
