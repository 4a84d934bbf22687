from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import invert_rigid, rigid, transform
from pimper_torch.geometry.surfaces import barycentric_2d, face_normals
from pimper_torch.geometry.template_normals import coarse_normals
from pimper_torch.lighting.light_field import harmonics, rotate_lights
from pimper_torch.records import CoarseMesh, Mesh, Observations, PatchSet, PatchViews, Templates


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(606)


@dataclass
class Scene:
    seen: PatchViews
    normals: list[Tensor]  # truth, patch frame, one a bucket
    albedo: list[Tensor]
    lights: Tensor  # world


def random_lights(views: int, generator: torch.Generator) -> Tensor:
    lights = 0.5 * torch.randn(views, 4, generator=generator, dtype=torch.float64)
    lights[:, 0] = 1 + lights[:, 0].abs()
    lights[:, 3] = -0.6 - lights[:, 3].abs()  # from the viewer's side
    return lights


@pytest.fixture
def scene(generator: torch.Generator) -> Callable[..., Scene]:
    """A cap of eight facets, rendered without noise on its templates."""

    def make(
        bumps: float = 0.25, views: int = 12, lights: Tensor | None = None, size: int = 14
    ) -> Scene:
        patches = PatchSet(coarse=cap(), buckets=())
        patches = patches.replace(
            buckets=(
                templates(patches.coarse, torch.arange(5), size),
                templates(patches.coarse, torch.arange(5, 8), size + 3),
            )
        )
        shine = random_lights(views, generator) if lights is None else lights
        buckets, normals, albedo = [], [], []
        for each in patches.buckets:
            bent = coarse_normals(patches.coarse, each)
            noise = torch.randn(bent.shape, generator=generator, dtype=torch.float64)
            bent = normalize(bent + bumps * noise.clamp(-2, 2), dim=-1)
            bent[..., 2] = bent[..., 2].clamp_max(-0.2)
            bent = normalize(bent, dim=-1)
            rho = 0.3 + 0.5 * torch.rand(*bent.shape[:3], generator=generator, dtype=torch.float64)
            rho = rho[..., None] * torch.tensor([1.2, 1.0, 0.8], dtype=torch.float64)
            shading = torch.einsum(
                "pfi,phwi->pfhw", rotate_lights(each.patch_from_world, shine), harmonics(bent)
            )
            radiance = shading[:, :, None] * rho.movedim(-1, 1)[:, None]
            valid = each.inside[:, None] & (shading > 0.05)
            radiance = torch.where(valid[:, :, None], radiance, 0)
            buckets.append(Observations(radiance=radiance, valid=valid))
            normals.append(bent)
            albedo.append(rho)
        seen = PatchViews(patches=patches, buckets=tuple(buckets))
        return Scene(seen=seen, normals=normals, albedo=albedo, lights=shine)

    return make


def cap() -> CoarseMesh:
    angle = torch.arange(8, dtype=torch.float64) * torch.pi / 4
    ring = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.6)], dim=1)
    vertices = torch.cat([torch.zeros(1, 3, dtype=torch.float64), ring])
    around = torch.arange(8)
    faces = torch.stack([torch.zeros(8, dtype=torch.int64), 1 + (around + 1) % 8, 1 + around], 1)
    center = torch.tensor([0, 0, 1.2], dtype=torch.float64)
    mesh = Mesh(
        vertices_world=vertices, faces=faces, normals_world=normalize(vertices - center, dim=1)
    )
    return CoarseMesh(mesh=mesh, reference=0, is_point=torch.ones(9, dtype=torch.bool))


def templates(coarse: CoarseMesh, facets: Tensor, size: int) -> Templates:
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[facets]]
    outward = normalize(face_normals(coarse.mesh.vertices_world, coarse.mesh.faces)[facets], dim=1)
    assert (outward[:, 2] < 0).all()
    x = normalize(corners[:, 1] - corners[:, 0], dim=1)
    world_from_patch = rigid(
        torch.stack([x, torch.linalg.cross(-outward, x), -outward], dim=2), corners[:, 0]
    )
    patch_from_world = invert_rigid(world_from_patch)
    flat = transform(patch_from_world, corners)[..., :2]
    low, high = flat.amin(dim=1) - 0.1, flat.amax(dim=1) + 0.1
    spacing = (high - low).amax(dim=1) / (size - 1)
    grid = torch.stack(
        torch.meshgrid(torch.arange(size), torch.arange(size), indexing="xy"), dim=-1
    )
    points = low[:, None, None] + spacing[:, None, None, None] * grid
    barycentric = barycentric_2d(points, flat[:, None, None])
    return Templates(
        facet=facets,
        patch_from_world=patch_from_world,
        origin=low,
        spacing=spacing,
        depth=torch.zeros(len(facets), size, size, dtype=torch.float64),
        barycentric=barycentric,
        inside=(barycentric > -0.1).all(dim=-1),
    )
