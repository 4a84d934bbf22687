import filecmp
import json

import numpy as np
import pytest
import torch
from scenes import write_ball
from torch.testing import assert_close

from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_files import unpack_maps
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.geometry.projection import project
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.photographs import load_views
from pimper_torch.runtime.errors import ConfigError, OutputError, PimperWarning

SMALL = SceneConfig(num_views=3, width=48, height=36, supersample=1)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return write_ball(tmp_path_factory.mktemp("meshes") / "ball.ply")


@pytest.fixture(scope="module")
def rendering(ball, tmp_path_factory):
    return render_scene(ball, tmp_path_factory.mktemp("out") / "scene", SMALL, processes=1)


def test_a_rendering_has_the_documented_files(rendering):
    assert sorted(path.name for path in rendering.iterdir()) == [
        ".pimper.json",
        "masks",
        "photos",
        "truth",
    ]
    truth = {path.name for path in (rendering / "truth").iterdir()}
    assert truth == {"scene.json", "sparse", "lights.json", "mesh.ply", "surroundings.ply", "maps"}
    for part, suffix in (("photos", "png"), ("masks", "png"), ("truth/maps", "npz")):
        held = sorted(path.name for path in (rendering / part).iterdir())
        assert held == [f"view_{view:03d}.{suffix}" for view in range(3)]
    report = json.loads((rendering / "truth" / "scene.json").read_text())
    assert report["settings"]["width"] == 48


def test_true_points_are_on_the_surface_of_the_maps(rendering):
    model = read_model(rendering / "truth" / "sparse")
    assert model.names == tuple(f"view_{view:03d}.png" for view in range(3))
    assert len(model.points_world) > 500
    center = model.points_world.new_tensor([0.0, 0.0, 1.2])
    radius = (model.points_world - center).norm(dim=1)
    assert ((radius < 1.2 + 1e-6) & (radius > 1.2 * 0.99)).all()  # facets are inside the ball
    compared = 0
    for view, lens in enumerate(model.lenses):
        with np.load(rendering / "truth" / "maps" / f"view_{view:03d}.npz") as arrays:
            maps = unpack_maps(arrays)
        own = model.observation_view == view
        points = model.points_world[model.observation_point[own]]
        fx, fy, cx, cy = lens.params
        K = points.new_tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        pixels, depth = project(points, model.cam_from_world[view], K)
        assert_close(pixels, model.observation_pixels[own], atol=1e-6, rtol=0)
        u, v = pixels.long().unbind(dim=-1)
        inner = maps["foreground"][v, u]
        gap = (maps["depth"][v, u].double() - depth).abs()[inner]
        # Half a pixel is 0.04 wide here; the steepest facet evaluated rises 5 times that.
        assert gap.max() < 0.25
        assert gap.median() < 0.03
        compared += int(inner.sum())
    assert compared > 1000


@pytest.mark.slow
def test_the_files_do_not_depend_on_the_number_of_processes(rendering, ball, tmp_path):
    render_scene(ball, tmp_path / "two", SMALL, processes=2)
    names = sorted(path.relative_to(rendering) for path in rendering.rglob("*") if path.is_file())
    assert len(names) > 10
    for name in names:
        if name.name == ".pimper.json":  # the times of the files
            continue
        if name.suffix == ".npz":  # a zip contains the time
            with np.load(rendering / name) as one, np.load(tmp_path / "two" / name) as two:
                assert all(np.array_equal(one[key], two[key], equal_nan=True) for key in one)
        else:
            assert filecmp.cmp(rendering / name, tmp_path / "two" / name, shallow=False), name


def test_a_folder_in_use_is_refused_before_any_work(ball, rendering, tmp_path):
    with pytest.raises(OutputError, match="already contains"):
        render_scene(ball, rendering, SMALL, processes=1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"letter\.txt"):
        render_scene(ball, tmp_path / "mine", SMALL, processes=1, overwrite=True)


def test_zero_processes_are_refused(ball, tmp_path):
    with pytest.raises(ConfigError, match="processes is 0"):
        render_scene(ball, tmp_path / "out", SMALL, processes=0)
    assert not (tmp_path / "out").exists()


def test_several_lights_per_pose_have_one_camera_and_one_folder_each(ball, tmp_path):
    config = SceneConfig(num_views=6, lights_per_pose=2, width=48, height=36, supersample=1)
    folder = render_scene(ball, tmp_path / "scene", config, processes=1)
    with pytest.warns(PimperWarning, match="3 camera poses"):
        views = load_views(folder / "photos", masks=folder / "masks")
    assert views.names[2:4] == ("pose_01/light_00.png", "pose_01/light_01.png")
    assert views.poses.tolist() == [0, 0, 1, 1, 2, 2]
    model = read_model(folder / "truth" / "sparse")
    assert model.names == views.names
    assert torch.equal(model.cam_from_world[::2], model.cam_from_world[1::2])
    assert not torch.equal(model.cam_from_world[1], model.cam_from_world[2])
    assert torch.equal(views.masks[::2], views.masks[1::2])
    lights = torch.tensor(json.loads((folder / "truth/lights.json").read_text())["positions_world"])
    assert len(lights.unique(dim=0)) == 6
    capture = read_rendered(folder)
    assert torch.equal(capture.views.images, views.images)
    assert capture.position.tolist() == capture.views.poses.tolist() == views.poses.tolist()
    assert capture.truth.depth.shape == (6, 36, 48)
