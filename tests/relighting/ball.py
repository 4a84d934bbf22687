"""Photographs of a unit ball in closed form, and the ball as a mesh."""

from functools import cache

import torch
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.directions import even_directions
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.io.tensors import scene_of
from pimper_torch.records import Mesh, ViewLights

SIDE = 80


def ring(views):
    """Cameras around the ball, on its equator."""
    angle = torch.arange(views, dtype=torch.float64) * (2 * torch.pi / views)
    eyes = 4 * torch.stack([angle.cos(), angle.sin(), 0.2 * torch.ones_like(angle)], dim=1)
    pose = look_at(eyes, torch.zeros(3).double(), torch.tensor([0.0, 0, 1]).double())
    return pinholes(pose, 1.6 * SIDE, SIDE, SIDE).to(torch.float32)


def lights_near(cameras):
    """Tinted lights, each about 40 degrees from its camera, on varying sides."""
    eyes = normalize(cameras.centers_world.double(), dim=1)
    aside = normalize(even_directions(len(eyes)), dim=1)
    tint = torch.tensor([0.9, 0.8, 0.6]).double()
    strength = 0.7 + 0.2 * torch.arange(len(eyes)).double().remainder(2)
    return ViewLights(
        direction_world=normalize(eyes + 0.7 * aside, dim=1).float(),
        ambient=(0.1 * torch.tensor([0.6, 0.8, 1.0])).expand(len(eyes), 3).contiguous(),
        inverse_distance=torch.zeros(len(eyes)),
        directed=(strength[:, None] * tint).float(),
    )


def colours(points):
    """Base colour on the ball: a large part is 0.9, the value to which it is scaled."""
    waves = 0.5 + 0.5 * torch.sin(points @ points.new_tensor([[5.0, 2, 1], [1, 6, 2], [3, 1, 4]]))
    return (0.15 + 0.9 * waves).clamp(max=0.9)


def ball_mesh(albedo=colours):
    """The ball as a mesh; its albedo is known up to a scale, as in a result."""
    vertices, faces = icosphere(5)
    return Mesh(
        vertices_world=vertices.float(),
        faces=faces,
        normals_world=vertices.float(),
        albedo=0.37 * albedo(vertices).float(),
    )


def textbook(normal, to_light, to_eye, base, material):
    """Compute radiance under a light of strength 1 by glTF's specification, appendix B."""
    metallic, roughness, specular = material
    half = normalize(to_light + to_eye, dim=-1)

    def dot(one, other):
        return (one * other).sum(dim=-1, keepdim=True)

    cosine, seen = dot(normal, to_light).clamp_min(0), dot(normal, to_eye).clamp_min(1e-6)
    squared = roughness**4
    density = squared / (torch.pi * (dot(normal, half) ** 2 * (squared - 1) + 1) ** 2)

    visible = 0.5 / (
        cosine * (seen**2 * (1 - squared) + squared).sqrt()
        + seen * (cosine**2 * (1 - squared) + squared).sqrt()
    )
    head_on = 0.04 * specular * (1 - metallic) + metallic * base
    edge = min(specular, 1) * (1 - metallic) + metallic
    fresnel = head_on + (edge - head_on) * (1 - dot(half, to_eye)) ** 5
    return cosine * ((1 - metallic) * base + torch.pi * density * visible * fresnel)


@cache
def photographed(material, views=6, albedo=colours):
    """Return photographs of a ball of one material as a scene, and their lights."""
    cameras = ring(views)
    lights = lights_near(cameras)
    pixels = pixel_centers(SIDE, SIDE, like=torch.zeros(1).double()).reshape(-1, 2)
    images = []
    for view in range(views):
        eye = cameras.centers_world[view].double()
        rays = rays_through(
            pixels, cameras.cam_from_world[view].double(), cameras.intrinsics[view].double()
        )
        rays = normalize(rays, dim=1)
        along = -rays @ eye
        under = along**2 - eye.square().sum() + 1
        met = under > 0
        point = eye + (along - under.clamp_min(0).sqrt())[:, None] * rays
        base = albedo(point)
        to_light = lights.direction_world[view].double().expand_as(point)
        lit = textbook(point, to_light, -rays, base, material)
        radiance = lights.ambient[view] * base + lights.directed[view] * lit
        image = torch.where(met[:, None], radiance, 0.02).clamp(0, 1).float()
        images.append(image.mT.reshape(3, SIDE, SIDE))
    scene = scene_of(torch.stack(images), cameras.intrinsics, cameras.cam_from_world)
    return scene, lights
