import pytest
import torch
from sparse_models import views_of

from pimper_bench.metrics.similarity import similarity_between_cameras
from pimper_bench.scenes.procedural_meshes import potato
from pimper_bench.scenes.ray_tracing import TracedObjects, render_frame
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.meshes import write_ply
from pimper_torch.runtime.errors import PimperWarning, ReconstructionError
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig

QUICK = ReconstructConfig(
    peak_threshold=0.0067,
    affine_shape=False,
    guided_pairs=0,
    starts=0,
    track_iterations=0,
    threads=1,
)


@pytest.fixture(scope="module")
def solid(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes") / "potato.ply"
    write_ply(potato(torch.Generator().manual_seed(3), subdivisions=5), path)
    return path


def photographs(scene, chosen):
    """Return some photographs of a scene in 8 bits."""
    taken = []
    for view in chosen:
        stage = TracedObjects(scene.objects_in(view))
        frame = render_frame(
            stage, scene.cameras, scene.lights, view, scene.noise(view), scene.config.sensor
        )
        taken.append((frame.image, frame.foreground))
    images, masks = (torch.stack(part) for part in zip(*taken, strict=True))
    return views_of(images, names=tuple(scene.names[view] for view in chosen), masks=masks)


def furnished(solid, **changes):
    settings = {"num_views": 24, "width": 320, "height": 240, "path": "turntable"}
    fixed = {"fixed_point_light": True, "fixed_room": True}
    return build_scene(solid, SceneConfig(**(settings | fixed | changes)))


def center_errors(found, scene):
    """Return the error of each camera centre relative to its distance."""
    rows = torch.tensor([scene.names.index(name) for name in found.views.names])
    true = scene.cameras.replace(
        intrinsics=scene.cameras.intrinsics[rows],
        cam_from_world=scene.cameras.cam_from_world[rows],
        sizes_px=scene.cameras.sizes_px[rows],
    )
    fit = similarity_between_cameras(found.cameras, true).double()
    ours = transform(fit, found.cameras.centers_world.double())
    return (ours - true.centers_world).norm(dim=1) / true.centers_world.norm(dim=1)


def compare(views, scene):
    """Return median errors of the cameras, without and with masks of the object."""
    with pytest.warns(PimperWarning, match="features are static .* and removed"):
        without = Reconstruct(QUICK)(views.replace(masks=None))
    masked = Reconstruct(QUICK)(views)  # a warning would be an error
    assert without.unregistered == masked.unregistered == ()
    return tuple(float(center_errors(found, scene).median()) for found in (without, masked))


@pytest.mark.slow
def test_cameras_follow_the_object_despite_a_static_background(solid):
    scene = furnished(solid, fixed_table=True)
    without, masked = compare(photographs(scene, list(range(6))), scene)
    assert masked < 0.003
    assert without < 1.5 * masked  # the same features, except those at mask borders


@pytest.mark.slow
@pytest.mark.parametrize("jitter", [{"pan_jitter_px": 30.0}, {"crop_jitter_px": 30.0}])
def test_cameras_follow_the_object_despite_a_shifting_background(solid, jitter):
    larger = {"width": 480, "height": 360, "num_views": 36}
    scene = furnished(solid, fixed_table=True, **larger, **jitter)
    views = photographs(scene, list(range(6))).replace(masks=None)
    with pytest.warns(PimperWarning, match=r"background shifts relative to .*\(`--masks`\)"):
        found = Reconstruct(QUICK)(views)
    assert found.unregistered == ()
    assert center_errors(found, scene).median() < 0.005


def test_photographs_of_one_position_are_rejected_with_advice(solid):
    scene = furnished(solid)
    (image,) = photographs(scene, [3]).images
    generator = torch.Generator().manual_seed(4)
    noise = 0.004 * torch.randn(4, *image.shape, generator=generator)
    views = views_of((image + noise).clamp(0, 1))
    ways = "masks.*plain cloth.*move the camera"
    with pytest.raises(ReconstructionError, match=f"Nothing moves in 4 photographs.*{ways}"):
        Reconstruct(QUICK)(views)
