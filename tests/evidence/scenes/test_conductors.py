import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.evidence.scenes.procedural_meshes import icosphere, moved, table
from pimper_torch.evidence.scenes.ray_tracing import TracedObjects
from pimper_torch.evidence.scenes.scene_lights import PointLight, random_environment
from pimper_torch.evidence.scenes.scene_object import CONDUCTORS, Conductor, SceneObject
from pimper_torch.geometry.directions import even_directions
from pimper_torch.records import Mesh


def point_light(**changes):
    """Only ambient light, unless told."""
    dark = {"irradiance": 0.0, "ambient": 1.0, "flash": 0.0}
    place = {"position": torch.tensor([0.0, 0.0, 9.0]), "target": torch.zeros(3)}
    return PointLight(**(place | dark | changes))


def radiance(stage, eye, rays, light, **changes):
    spots = stage.trace(eye, rays)
    shaded = stage.shade(spots, eye, light, **changes)
    return spots, shaded.matte + shaded.mirrored


def mirrored_about(directions, normals):
    """The vector that leaves a mirror, for one that comes in."""
    return directions - 2 * (directions * normals).sum(dim=-1, keepdim=True) * normals


@pytest.mark.parametrize("name", CONDUCTORS)
def test_head_on_the_reflectance_has_its_closed_form(name):
    metal = CONDUCTORS[name]
    n = torch.tensor(metal.index, dtype=torch.float64)
    k = torch.tensor(metal.extinction, dtype=torch.float64)
    expected = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    cosine = torch.tensor([1.0, 0.0], dtype=torch.float64)
    found = metal.reflectance(cosine)
    assert_close(found[0], expected)
    assert_close(found[1], torch.ones_like(expected))  # grazing
    assert (metal.reflectance(torch.linspace(0, 1, 50, dtype=torch.float64)) <= 1 + 1e-12).all()


def test_copper_has_its_published_colour():
    # Source: Hoffman, Background: Physics and Math of Shading, SIGGRAPH 2013 course; filtered
    # by the primaries, where ours are single wavelengths.
    found = CONDUCTORS["copper"].reflectance(torch.ones(1))[0]
    assert_close(found, torch.tensor([0.95, 0.64, 0.54]), atol=0.03, rtol=0)


def test_without_extinction_brewsters_angle_leaves_one_polarization():
    glass = Conductor(index=(1.5, 1.5, 1.5), extinction=(0.0, 0.0, 0.0))
    brewster = torch.atan(torch.tensor([1.5], dtype=torch.float64))
    refracted = torch.asin(brewster.sin() / 1.5)
    across = (torch.sin(brewster - refracted) / torch.sin(brewster + refracted)) ** 2
    assert_close(glass.reflectance(brewster.cos())[0], (across / 2).expand(3))


def test_a_flat_mirror_shows_what_is_above_it(generator):
    """Closed form: the floor mirrors a patterned ceiling in ambient light."""

    def pattern(points):
        return torch.stack([0.5 + 0.4 * torch.sin(2 * points[..., axis]) for axis in (0, 1, 0)], -1)

    ceiling = moved(table(20.0), shift=(0.0, 0.0, 3.0))
    metal = CONDUCTORS["copper"]
    black = torch.zeros_like
    floor = SceneObject(mesh=table(4.0), texture=black, conductor=metal)
    stage = TracedObjects([floor, SceneObject(mesh=ceiling, texture=pattern, surroundings=True)])
    eye = torch.tensor([0.3, -0.2, 1.0])
    down = torch.randn(200, 3, generator=generator)
    down[:, 2] = -1.5
    rays = normalize(down, dim=-1)
    spots, seen = radiance(stage, eye, rays, point_light())
    assert (spots.object_index == 0).all()
    rise = 3 - stage.clearance  # the reflected ray starts clear of the mirror
    at_ceiling = spots.points + rays * rays.new_tensor([1.0, 1, -1]) * (rise / -rays[:, 2:])
    expected = metal.reflectance(-rays[:, 2]) * pattern(at_ceiling)
    assert_close(seen, expected, atol=1e-4, rtol=0)


def test_a_mirroring_sphere_shows_the_environment_by_the_reflected_ray(generator):
    vertices, faces = icosphere(6)
    mesh = Mesh(vertices_world=vertices, faces=faces, normals_world=vertices)
    stage = TracedObjects(
        [SceneObject(mesh=mesh, texture=torch.zeros_like, conductor=CONDUCTORS["gold"])]
    )
    picture = random_environment(generator)
    eye = torch.tensor([0.0, -4.0, 1.0])
    toward = 0.9 * even_directions(4000).float()
    rays = normalize(toward - eye, dim=-1)
    spots, seen = radiance(stage, eye, rays, point_light(ambient=0.3, environment=picture))
    met = spots.object_index >= 0
    normals = spots.normals[met]
    out = mirrored_about(rays[met], normals)
    fraction = CONDUCTORS["gold"].reflectance(-(rays[met] * normals).sum(dim=-1))
    assert_close(seen[met], 0.3 * fraction * picture(out), atol=1e-4, rtol=1e-3)
    assert seen[met].std() > 0.05


def test_mirrors_face_to_face_end():
    up = SceneObject(mesh=table(4.0), texture=torch.zeros_like, conductor=CONDUCTORS["silver"])
    above = moved(table(4.0), shift=(0.0, 0.0, 2.0))
    down = above.replace(faces=above.faces.flip(1), normals_world=-above.normals_world)
    stage = TracedObjects(
        [up, SceneObject(mesh=down, texture=torch.zeros_like, conductor=CONDUCTORS["silver"])]
    )
    eye = torch.tensor([0.0, 0.0, 1.0])
    rays = normalize(torch.tensor([[0.0, 0.1, -1.0]]), dim=-1)
    _, seen = radiance(stage, eye, rays, point_light())
    assert (seen == 0).all()  # nothing shines, and nothing recurses for ever


def test_a_point_light_on_metal_has_the_metals_colour():
    def highlight(**material):
        item = SceneObject(mesh=table(4.0), texture=torch.zeros_like, roughness=0.3, **material)
        eye = torch.tensor([0.0, 0.0, 3.0])
        down = torch.tensor([[0.0, 0.0, -1.0]])
        return radiance(TracedObjects([item]), eye, down, point_light(irradiance=1.0, ambient=0.0))[
            1
        ][0]

    copper = highlight(conductor=CONDUCTORS["copper"])
    full = highlight(specular=1.0)
    assert_close(copper, full * CONDUCTORS["copper"].reflectance(torch.ones(1))[0])


def test_an_environment_has_mean_one_and_bright_windows(generator):
    picture = random_environment(generator)(even_directions(1 << 15))
    assert_close(picture.mean(), torch.tensor(1.0, dtype=torch.float64), atol=0.02, rtol=0)
    assert picture.max() > 3
    assert (picture >= 0).all()


def test_directions_on_a_spiral_are_even():
    directions = even_directions(4000)
    assert_close(directions.norm(dim=1), torch.ones(4000, dtype=torch.float64))
    second = directions.mT @ directions / 4000
    assert_close(second, torch.eye(3, dtype=torch.float64) / 3, atol=1e-3, rtol=0)
