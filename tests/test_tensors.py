"""From tensors to a saved result, and inspection of a run."""

import logging
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from probes import small_scene

import pimper_torch as pt
from pimper_torch.chains.prepare import locate
from pimper_torch.geometry.local_frame import from_local
from pimper_torch.geometry.projection import project
from tests.sfm.ball import cameras_on_an_arc, photographs

SCRIPT = Path(__file__).parent / "scripts" / "look_inside.py"


@pytest.fixture(scope="module")
def given():
    """Photographs of a ball, its cameras, its cloud, and facets."""
    return small_scene(num_views=6, width=64)


def scene_of(scene, **changes):
    fields = {
        "images": scene.views.images.float(),
        "intrinsics": scene.cameras.intrinsics,
        "cam_from_world": scene.cameras.cam_from_world,
    }
    return pt.scene_of(**(fields | changes))


def test_a_scene_of_tensors_equals_that_of_structure_from_motion(given):
    scene, _ = given
    made = scene_of(scene, points_world=scene.points_world, observed=scene.observed)
    assert torch.equal(made.observed, scene.observed)
    assert torch.equal(made.cameras.intrinsics, scene.cameras.intrinsics.float())
    point, view = made.observation_point, made.observation_view
    pixels, _ = project(scene.points_world, scene.cameras.cam_from_world, scene.cameras.intrinsics)
    torch.testing.assert_close(made.observation_pixels, pixels[view, point].float())
    assert [lens.camera for lens in made.lenses] == [1] * 6  # one K: one camera


def test_arrays_lists_one_pinhole_and_poses_of_three_rows_are_accepted(given):
    scene, _ = given
    made = scene_of(
        scene,
        images=scene.views.images.float().numpy(),
        intrinsics=scene.cameras.intrinsics[0].tolist(),
        cam_from_world=scene.cameras.cam_from_world[:, :3].numpy(),
        masks=np.ones((6, 48, 64), dtype=np.uint8),
    )
    torch.testing.assert_close(made.cameras.cam_from_world, scene.cameras.cam_from_world.float())
    assert made.cameras.intrinsics.shape == (6, 3, 3)
    assert made.views.masks.dtype == torch.bool


def test_a_point_counts_as_observed_if_it_projects_onto_the_object(given):
    scene, _ = given
    masks = torch.ones(6, 48, 64, dtype=torch.bool)
    masks[2] = False
    made = scene_of(scene, points_world=torch.tensor([[0.0, 0, 0], [50, 0, 0]]), masks=masks)
    assert made.observed[0].tolist() == [True, True, False, True, True, True]
    assert not made.observed[1].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": torch.zeros(3, 3)}, r"images has shape \(3, 3\); needed: view channel"),
        ({"images": torch.zeros(6, 3, 48, 64, dtype=torch.uint8)}, "images is uint8; .*load_views"),
        ({"intrinsics": torch.eye(3)[:2]}, r"intrinsics is float32\[2, 3\]; needed: "),
        ({"intrinsics": -torch.eye(3)}, "6 matrices that are not K, the first"),
        ({"cam_from_world": torch.eye(4).repeat(5, 1, 1)}, r"cam_from_world is float32\[5, 4, 4\]"),
        (
            {"cam_from_world": 2 * torch.eye(4).repeat(6, 1, 1)},
            "6 of 6 matrices that are not rigid",
        ),
        ({"masks": torch.ones(6, 4, 4)}, r"masks is bool\[6, 4, 4\]"),
        ({"names": ["a"] * 6}, "names has 6 entries, 1 of which"),
        ({"points_world": [[0.0, 0, 1]], "observed": [[True]]}, r"observed has shape \(1, 1\)"),
    ],
)
def test_an_invalid_scene_is_refused_by_name(given, change, message):
    with pytest.raises(pt.InputError, match=message):
        scene_of(given[0], **change)


def test_cameras_of_a_different_convention_are_recognised(given):
    scene, _ = given
    opengl = scene.cameras.cam_from_world.clone()
    opengl[:, 1:3] *= -1
    with pytest.raises(pt.InputError, match=r"look away from the cloud: 100%.*OpenGL"):
        scene_of(scene, cam_from_world=opengl, points_world=scene.points_world)
    mirrored = scene.cameras.cam_from_world.clone()
    mirrored[:, 0] *= -1
    with pytest.raises(pt.InputError, match=r"mirror \(determinant -1"):
        scene_of(scene, cam_from_world=mirrored)


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
def test_from_tensors_to_a_saved_result(given, tmp_path):
    scene, coarse = given
    chain = pt.load_chain("default", {"scales": [1.0], "silhouettes": {"object": "everything"}})
    result = chain(scene_of(scene), mesh=coarse.mesh)
    pt.write_result(result, chain.config, tmp_path / "out")
    mesh = trimesh.load(tmp_path / "out" / "mesh.ply")
    off = np.linalg.norm(mesh.vertices, axis=1) - 1  # the ball's radius
    assert np.abs(off).mean() < 0.01
    assert (tmp_path / "out" / "sparse" / "cameras.bin").is_file()
    with pytest.raises(pt.InputError, match="cameras are given twice"):
        chain(scene_of(scene), tmp_path)


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
def test_a_researcher_inspects_a_run(given, tmp_path, caplog):
    scene, coarse = given
    main = runpy.run_path(str(SCRIPT))["main"]
    with caplog.at_level(logging.INFO, logger="run"):
        main(scene.to(torch.float32), coarse.mesh, tmp_path / "patch.png")
    assert len(caplog.records) == 2 * 5
    assert all(len(record.getMessage()) < 2000 for record in caplog.records)
    assert (tmp_path / "patch.png").stat().st_size > 5000
    assert sum(bool(line.strip()) for line in SCRIPT.read_text().splitlines()) <= 30


@pytest.mark.parametrize("kind", ["tensors", "arrays", "lists"])
def test_cameras_far_from_the_origin_give_the_same_scene(given, kind):
    scene, _ = given
    offset = torch.tensor([448231.25, 5411923.5, 312.125], dtype=torch.float64)
    poses = from_local(scene.cameras.cam_from_world.double(), tuple(offset.tolist()))
    points = scene.points_world.double() + offset
    if kind == "arrays":
        poses, points = poses.numpy(), points.numpy()
    elif kind == "lists":
        poses, points = poses.tolist(), points.tolist()
    near = scene_of(scene, points_world=scene.points_world)
    far = scene_of(scene, cam_from_world=poses, points_world=points)
    shift = offset - torch.tensor(far.offset_world, dtype=torch.float64)
    assert near.offset_world == (0.0, 0.0, 0.0)
    assert float(shift.abs().max()) < 2
    wanted = (near.points_world + shift).float()
    torch.testing.assert_close(far.points_world, wanted, rtol=0, atol=1e-6)
    assert torch.equal(far.observed, near.observed)
    torch.testing.assert_close(far.observation_pixels, near.observation_pixels, rtol=0, atol=1e-3)


def test_gradients_reach_cameras_far_from_the_origin(given):
    scene, _ = given
    poses = from_local(scene.cameras.cam_from_world.double(), (1e6, 0.0, 0.0)).requires_grad_()
    scene_of(scene, cam_from_world=poses).cameras.cam_from_world.sum().backward()
    assert torch.equal(poses.grad[:, :3, 3], torch.ones_like(poses[:, :3, 3]))


def placed(scene):
    chain = pt.load_chain("fast")
    return locate(chain, chain.running(), scene)[0]


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
def test_a_chain_triangulates_points_for_given_poses():
    cameras = cameras_on_an_arc()
    views = photographs(cameras, lit=False)
    made = pt.scene_of(views.images.float(), cameras.intrinsics, cameras.cam_from_world)
    found = placed(made)
    assert len(found.points_world) > 100
    assert float((found.points_world.norm(dim=1) - 1).abs().median()) < 0.003
    assert torch.equal(found.cameras.cam_from_world, made.cameras.cam_from_world)
    assert torch.equal(found.cameras.intrinsics, made.cameras.intrinsics)


@pytest.mark.parametrize("preset", ["default", "fast"])
def test_an_unknown_reference_is_refused_before_structure_from_motion(preset, monkeypatch):
    views = photographs(cameras_on_an_arc(), lit=False)
    chain = pt.load_chain(preset, {"coarse_surface": {"reference": "nobody"}})
    monkeypatch.setattr("pimper_torch.chains.chain.prepare", lambda *given: pytest.fail("it ran"))
    with pytest.raises(pt.InputError, match=r"'nobody': no photographs have this name; needed"):
        chain(views)


def test_a_chain_refuses_poses_of_a_different_convention():
    cameras = cameras_on_an_arc()
    views = photographs(cameras, lit=False)
    poses = cameras.cam_from_world.inverse()
    made = pt.scene_of(views.images.float(), cameras.intrinsics, poses)
    with pytest.raises(pt.InputError, match=r"The scene: these cameras.*not its inverse"):
        placed(made)
