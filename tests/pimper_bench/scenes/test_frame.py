import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import moved, potato, table
from pimper_bench.scenes.ray_tracing import TracedObjects, render_frame
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import Lights
from pimper_bench.scenes.scene_object import SceneObject
from pimper_bench.scenes.scene_settings import SensorConfig
from pimper_bench.scenes.textures import random_speckle


@pytest.fixture(scope="module")
def objects():
    generator = torch.Generator().manual_seed(81)
    mesh = moved(potato(generator, subdivisions=4), scale=0.6)
    texture = random_speckle(generator, cells=(0.3, 0.1))
    return (
        SceneObject(mesh=mesh, texture=texture, specular=0.05, roughness=0.3),
        SceneObject(mesh=table(2.0, cells=8), texture=texture, surroundings=True),
    )


@pytest.fixture(scope="module")
def stage(objects):
    return TracedObjects(objects)


def shot(stage, sensor, seed=0, **changes):
    cameras = arc_cameras(1, width=60, height=45, focal_px=80.0, distance=3.0, span_deg=1.0)
    settings = {
        "positions_world": torch.tensor([[1.5, 1.0, 3.0]], dtype=torch.float64),
        "irradiance": torch.tensor([0.6], dtype=torch.float64),
        "ambient": torch.tensor([0.1], dtype=torch.float64),
        "target_world": torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64),
    }
    generator = torch.Generator().manual_seed(seed)
    lights = Lights(**(settings | changes))
    return render_frame(stage, cameras, lights, 0, generator, sensor)


def sensor(**changes):
    return SensorConfig(**({"read_noise": 0.0, "shot_noise": 0.0} | changes))


def test_adaptive_sampling_is_as_accurate_as_uniform(stage, monkeypatch):
    from pimper_bench.scenes import ray_tracing

    coarse = shot(stage, sensor(supersample=1)).image
    adaptive = shot(stage, sensor(supersample=3)).image
    monkeypatch.setattr(ray_tracing, "_UNEVEN", -1.0)
    everywhere = shot(stage, sensor(supersample=3)).image
    gap = (adaptive - everywhere).abs()
    assert gap.max() < 0.03  # the limit between neighbours below which pixels are not refined
    assert gap.mean() < 1e-3
    assert (coarse - everywhere).abs().mean() > 4 * gap.mean()


def test_exposure_multiplies_radiance_before_it_saturates(stage):
    once = shot(stage, sensor(supersample=1)).image
    thrice = shot(stage, sensor(supersample=1, exposure=3.0)).image
    assert_close(thrice, (3 * once).clamp_max(1), atol=1e-6, rtol=0)
    assert (thrice == 1).any()


def test_highlights_are_marked(stage, objects):
    glossy = shot(stage, sensor(supersample=1))
    matte = [SceneObject(mesh=item.mesh, texture=item.texture) for item in objects]
    plain = shot(TracedObjects(matte), sensor(supersample=1))
    assert not plain.highlight.any()
    assert glossy.highlight.any()
    assert not (glossy.highlight & ~glossy.foreground).any()
    assert not (glossy.highlight & ~glossy.lit).any()
    extra = (glossy.image - plain.image).amax(dim=0)
    assert extra[glossy.highlight].mean() > 0.05
    assert extra[~glossy.highlight].max() < 0.05


def test_maps_do_not_depend_on_the_sensor(stage):
    one = shot(stage, sensor(supersample=1))
    other = shot(stage, SensorConfig(supersample=2, read_noise=0.1), seed=5)
    for name in ("depth", "normals_world", "albedo", "foreground", "lit", "highlight"):
        assert_close(getattr(one, name), getattr(other, name))
    assert not torch.equal(one.image, other.image)
