"""Plausible mistakes are refused with a message that names the error and its fix."""

from pathlib import Path

import numpy as np
import pytest
import torch
from probes import small_scene

import pimper_torch as pt
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.chains.prepare import locate
from pimper_torch.radiometry import linear_from_srgb, to_bytes
from tests.coarse import ball

FLIP = torch.tensor([1.0, -1, -1, 1]).diag()


@pytest.fixture(scope="module")
def given():
    scene, _ = small_scene(num_views=4, width=48)
    return scene.to(torch.float32)


def scene_of(scene, images):
    return pt.scene_of(images, scene.cameras.intrinsics, scene.cameras.cam_from_world)


@pytest.mark.parametrize(
    ("mistaken", "message"),
    [
        (
            lambda linear: linear.permute(0, 2, 3, 1),
            r"images has shape \(4, 36, 48, 3\); .*1 or 3 channels.*`images.permute\(0, 3",
        ),
        (
            lambda linear: torch.cat([linear, linear[:, :1]], dim=1),
            r"images has shape \(4, 4, 36, 48\); needed: .* 1 or 3 channels\.$",
        ),
        (lambda linear: linear[:, 0], r"images has shape \(4, 36, 48\); needed: view channel"),
        (
            lambda linear: 255 * linear,
            r"images have values up to \d+.*\d% .* above 1; .*: divide .*linear_from_srgb",
        ),
        (to_bytes, r"images is uint8; .*usually.*linear_from_srgb\(images / 255\)`.*load_views"),
        (lambda linear: to_bytes(linear).numpy(), "images is uint8; "),
    ],
)
def test_images_of_a_wrong_layout_range_or_encoding_are_refused(given, mistaken, message):
    with pytest.raises(pt.InputError, match=message):
        scene_of(given, mistaken(given.views.images))


def test_srgb_images_are_warned_of_and_linear_ones_are_not(given, recwarn):
    coded = to_bytes(given.views.images) / 255
    with pytest.warns(pt.PimperWarning, match=r"1/255, .*usually sRGB.*linear_from_srgb\(images\)"):
        scene_of(given, coded)
    recwarn.clear()
    scene_of(given, linear_from_srgb(coded))
    scene_of(given, given.views.images)
    scene_of(given, (given.views.images > 0.3).float())
    scene_of(given, torch.where(given.views.images > 0.5, 40.0, given.views.images))  # highlights
    assert not recwarn.list


@pytest.mark.parametrize(
    ("mistaken", "message"),
    [
        (torch.linalg.inv, r"with `torch.linalg.inv\(poses\)`: the poses seem .* camera-to-world;"),
        (lambda poses: FLIP @ poses, r"with `flip @ poses`, where `flip = .*y up and z backward"),
        (
            lambda poses: torch.linalg.inv(FLIP @ poses),
            r"with `flip @ torch.linalg.inv\(poses\)`, where `flip = .*camera-to-world, y up",
        ),
    ],
)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_mesh_reveals_inverted_poses_and_flipped_axes(preset, mistaken, message):
    scene = ball.photographed(ball.all_round())
    vertices, faces = icosphere(1)
    mesh = pt.Mesh(vertices_world=vertices, faces=faces)
    chain = pt.load_chain(preset)
    locate(chain, chain.running(), scene, None, mesh)
    poses = mistaken(scene.cameras.cam_from_world)
    wrong = pt.scene_of(scene.views.images, scene.cameras.intrinsics, poses)
    with pytest.raises(
        pt.InputError, match=f"^The given mesh is in .* of 12 photographs.*{message}"
    ):
        chain(wrong, mesh=mesh)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: pt.load_chain("default", {"sweep": {"step": 7}}),
            "changes: section `sweep` has no setting `step`. Did you mean `steps`?",
        ),
        (
            lambda: pt.CoarseToFine(factorise=pt.Factorize()),
            "CoarseToFine has no stage `factorise`. Did you mean `factorize`? Stages: ",
        ),
        (
            lambda: pt.load_chain("paper", tryangulate=pt.Triangulate()),
            "Published has no stage `tryangulate`. Did you mean `triangulate`?",
        ),
    ],
)
def test_a_misspelt_stage_or_setting_suggests_the_nearest(call, message):
    with pytest.raises(pt.ConfigError) as caught:
        call()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize(
    ("handed", "message"),
    [
        ("photos/", "views is str; needed: Views or SparseScene. `load_views` reads"),
        (Path("photos"), "views is PosixPath; .* `load_views` reads"),
        (torch.zeros(3, 3, 8, 8), "views is Tensor; .* `scene_of` combines images"),
        (np.zeros((3, 3, 8, 8)), "views is ndarray; .* `scene_of` combines images"),
        (None, "views is NoneType; .*The caller of the stage passed it"),
    ],
)
def test_a_wrong_argument_for_views_names_the_function_that_makes_views(preset, handed, message):
    chain = pt.load_chain(preset)
    for call in (chain, lambda views: next(chain.steps(views))):
        with pytest.raises(pt.InputError, match=f"^{type(chain).__name__}: {message}"):
            call(handed)


def test_load_views_is_suggested_only_for_arguments_of_type_views(given):
    with pytest.raises(pt.InputError, match=r"^Warp: views is str; .* `load_views` reads"):
        pt.Warp()("photos/", given.cameras, None)
    with pytest.raises(pt.InputError, match=r"^Decompose: coarse is Tensor; .*The caller of the"):
        pt.Decompose()(torch.zeros(3, 3), given.cameras)
