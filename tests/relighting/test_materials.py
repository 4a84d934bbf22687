import pytest
import torch

from pimper_torch.stages.relighting.fit_lights import lights_of, observe_all
from pimper_torch.stages.relighting.fit_materials import colour_clusters, materials_under
from pimper_torch.stages.relighting.held_out import psnr, shaded
from pimper_torch.stages.relighting.lit_surface import LitSurface, response
from tests.relighting.ball import ball_mesh, colours, photographed, textbook
from tests.threads import on_threads

MATTE = (0.0, 1.0, 0.0)


def relit(material, views=6, albedo=colours):
    """Estimate lights and materials of a ball in two alternations."""
    scene, lights = photographed(material, views, albedo)
    surface = LitSurface(ball_mesh(albedo))
    observed = observe_all(surface, scene, None)
    matte = lights_of(surface, observed)
    materials = materials_under(surface, observed, matte)
    found = lights_of(surface, observed, materials, matte)
    return surface, observed, materials_under(surface, observed, found), matte, found, lights


@pytest.mark.parametrize("material", [(0.0, 0.3, 1.0), (0.0, 0.5, 2.0)])
def test_the_roughness_and_light_of_a_glossy_ball_are_estimated(material):
    surface, observed, materials, matte, found, lights = relit(material)
    assert len(materials.roughness) == 1
    assert float(materials.metallic) == 0
    assert abs(float(materials.roughness) - material[1]) < 0.1
    assert 0.5 * material[2] < float(materials.specular) < 1.5 * material[2]
    cosine = (found.direction_world * lights.direction_world).sum(dim=1).clamp(-1, 1)
    assert cosine.acos().rad2deg().max() < 2
    gains = [
        psnr(shaded(surface, seen.pixels, found.take([view]), materials), seen.radiance)
        - psnr(shaded(surface, seen.pixels, matte.take([view]), None), seen.radiance)
        for view, seen in enumerate(observed)
    ]
    assert min(gains) > 1


def test_a_matte_ball_has_no_highlight():
    *_, materials, _, _, _ = relit(MATTE)
    assert materials.values.tolist() == [list(MATTE)]


def test_one_photograph_determines_no_material():
    scene, _ = photographed((0.0, 0.3, 1.0), views=3)
    surface = LitSurface(ball_mesh())
    observed = observe_all(surface, scene, None)[:1]
    found = materials_under(surface, observed, lights_of(surface, observed))
    assert found.values.tolist() == [list(MATTE)]


def test_materials_and_lights_have_the_same_bits_on_any_number_of_threads():
    first, *others = on_threads(lambda: relit((0.0, 0.3, 1.0), views=3), 1, 2, 3)
    for _, _, materials, matte, found, _ in others:
        assert torch.equal(materials.values, first[2].values)
        for lights, own in ((matte, first[3]), (found, first[4])):
            assert torch.equal(lights.direction_world, own.direction_world)
            assert torch.equal(lights.directed, own.directed)


def test_radiance_agrees_with_the_gltf_specification():
    scene, lights = photographed((0.0, 0.4, 1.5), views=3)
    surface = LitSurface(ball_mesh())
    pixels = surface.pixels(scene.cameras.take([0]))
    incidence = surface.incidence(pixels, lights.direction_world[:1], torch.zeros(1))
    for material in [(0.0, 0.4, 1.5), (0.5, 0.3, 0.7), (1.0, 0.6, 1.0)]:
        found = response(pixels, incidence, torch.tensor(material).expand(len(pixels.pixel), 3))[0]
        wanted = textbook(
            pixels.normals_world,
            lights.direction_world[:1],
            pixels.to_eye,
            pixels.base_color,
            material,
        )
        lit = incidence.cosine[0] > 0.05
        assert torch.allclose(found[lit], wanted[lit], rtol=1e-3, atol=1e-5)


def test_colours_of_two_paints_are_two_clusters():
    red, blue = torch.tensor([0.6, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.7])
    paint = torch.arange(500).remainder(5) == 0
    colors = torch.where(paint[:, None], red, blue) + 0.01 * torch.rand(500, 3)
    found = colour_clusters(colors, 2)
    assert torch.equal(found == found[0], paint)


def test_a_surface_with_few_colours_has_one_cluster_per_colour():
    colours = torch.tensor([[0.2, 0.2, 0.2], [0.8, 0.1, 0.1]]).repeat(50, 1)
    assert len(colour_clusters(colours[::2], 2).unique()) == 1
    assert len(colour_clusters(colours, 3).unique()) == 2
