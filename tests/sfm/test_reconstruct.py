import warnings
from importlib.resources import files

import numpy as np
import pytest
import torch
from PIL import Image
from sparse_models import views_of
from torch.testing import assert_close

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.records import Views
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning, ReconstructionError
from pimper_torch.runtime.events import Progress
from pimper_torch.runtime.stream import collected
from pimper_torch.stages.sfm import reconstruct, registration, retrieval, track_observations
from pimper_torch.stages.sfm.features import workspace
from pimper_torch.stages.sfm.reconstruct import Reconstruct, find_model, structure_from_motion
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.sparse_scene import write_model
from pimper_torch.store import Store, digest


def blank(sizes: list[tuple[int, int]]) -> Views:
    width, height = (max(side) for side in zip(*sizes, strict=True))
    return views_of(torch.zeros(len(sizes), 3, height, width), sizes)


def named(*names):
    return lambda views: views.replace(names=names)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (named(*"vwxyz"), r"none of the photographs. Its images are b\.jpg.* photographs are v, w"),
        (named("b.jpg", "a.jpg", "x", "y", "z"), "2 of 5 photographs .*at least 3 are needed"),
    ],
)
def test_a_model_of_other_photographs_is_rejected(scene, views, tmp_path, change, sentence):
    write_model(scene, tmp_path)
    with pytest.raises((InputError, ReconstructionError), match=sentence):
        Reconstruct()(change(views), tmp_path)


def test_a_folder_without_a_model_is_rejected(views, tmp_path):
    with pytest.raises(InputError, match="no COLMAP model"):
        Reconstruct()(views, tmp_path)


def test_photographs_missing_from_the_model_are_excluded_with_a_warning(scene, views, tmp_path):
    write_model(scene, tmp_path)
    more = views.take([4, 0, 1, 2, 3]).replace(
        names=("ü.tif", "b.jpg", "new.jpg", "c 1.png", "d.jpg")
    )
    with pytest.warns(PimperWarning, match=r"4 of 5 photographs.*excluded: new\.jpg"):
        placed = Reconstruct()(more, tmp_path)
    assert placed.unregistered == ("new.jpg",)
    assert placed.given
    assert placed.views.names == ("ü.tif", "b.jpg", "c 1.png", "d.jpg")
    assert_close(
        placed.cameras.cam_from_world,
        scene.cameras.cam_from_world[[4, 0, 2, 3]],
        rtol=0,
        atol=1e-12,  # through quaternions
    )
    # Every observation keeps its pixel under the new indices.
    for index, old in enumerate([4, 0, 2, 3]):
        mine = placed.observation_view == index
        theirs = scene.observation_view == old
        points = placed.points_world[placed.observation_point[mine]]
        rivals = scene.points_world[scene.observation_point[theirs]]
        same = (points[:, None] == rivals).all(dim=-1)
        assert (same.sum(dim=1) == 1).all()
        nearest = same.long().argmax(dim=1)
        assert torch.equal(
            placed.observation_pixels[mine], scene.observation_pixels[theirs][nearest]
        )


def test_one_registered_image_gives_the_pose_of_its_folder(scene, views, tmp_path):
    write_model(scene, tmp_path)
    twice = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    names = [
        f"{name.rpartition('.')[0]}/light_{light}.tif" for name in views.names for light in "ab"
    ]
    lit = views.take(twice).replace(names=tuple(names), poses=torch.tensor(twice))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        placed, plain = Reconstruct()(lit, tmp_path), Reconstruct()(views, tmp_path)
    assert placed.views.names == tuple(names)
    assert placed.unregistered == ()
    assert torch.equal(placed.cameras.cam_from_world, plain.cameras.cam_from_world[twice])
    assert torch.equal(placed.points_world, plain.points_world)
    assert torch.equal(placed.observed, plain.observed[:, twice])


def test_a_models_subfolders_do_not_matter(scene, views, tmp_path):
    inside = scene.replace(
        views=scene.views.replace(names=tuple(f"images/{name}" for name in views.names))
    )
    write_model(inside, tmp_path)
    assert Reconstruct()(views, tmp_path).views.names == views.names
    assert Reconstruct()(views, str(tmp_path)).views.names == views.names


def test_a_model_of_larger_photographs_is_scaled_down(scene, views, tmp_path):
    write_model(scene, tmp_path)
    small = views.replace(
        images=views.images[..., ::2, ::2].contiguous(), sizes_px=views.sizes_px // 2
    )
    placed = Reconstruct()(small, tmp_path)
    assert_close(placed.cameras.intrinsics, scale_intrinsics(scene.cameras.intrinsics, 0.5, 0.5))
    assert_close(placed.observation_pixels, scene.observation_pixels / 2)
    assert_close(placed.reprojection_errors_px, scene.reprojection_errors_px / 2)


def test_photographs_of_one_camera_resized_differently_no_longer_share_it(scene, views, tmp_path):
    write_model(scene, tmp_path / "whole")
    images = views.images.clone()
    images[0, :, 30:] = 0
    images[0, :, :, 40:] = 0
    sizes = views.sizes_px.clone()
    sizes[0] = sizes[0] // 2
    mixed = views.replace(images=images, sizes_px=sizes)
    placed = Reconstruct()(mixed, tmp_path / "whole")
    assert_close(2 * placed.cameras.intrinsics[0, :2], scene.cameras.intrinsics[0, :2])
    assert_close(placed.cameras.intrinsics[1:], scene.cameras.intrinsics[1:])
    write_model(placed, tmp_path / "mixed")
    again = Reconstruct()(mixed, tmp_path / "mixed")
    assert again.lenses == placed.lenses
    assert_close(again.reprojection_errors_px, placed.reprojection_errors_px)


QUICK = {"affine_shape": False}
SIZES = [(40, 30)] * 3 + [(60, 45)]


@pytest.mark.parametrize(
    ("settings", "views", "sentence"),
    [
        (
            {"shared_camera": True},
            blank(SIZES),
            r"2 sizes \(40x30: 0.png, 1.png, 2.png; 60x45: 3.png\).*`--reconstruct.shared-camera`",
        ),
        ({}, blank(SIZES), "No features"),  # with a camera for each size
        ({}, blank([(40, 30)] * 3), r"No features.*3 of 3.*0\.png, 1\.png, 2\.png"),
        ({}, blank([(40, 30)] * 2), "at least 3 are needed, and 10 to 50 are usual"),
        (
            QUICK,
            views_of(torch.rand(4, 3, 64, 96, generator=torch.Generator().manual_seed(7))),
            r"registered 0 of 4 photographs.*0\.png",
        ),
        # COLMAP's detector would end the process.
        ({}, blank([(8, 6)] * 3), "have sides of fewer than 16 pixels"),
        ({}, blank([(64, 15)] * 3), "have sides of fewer than 16 pixels"),
    ],
)
def test_photographs_that_cannot_be_registered_are_rejected(settings, views, sentence):
    with pytest.raises((InputError, ReconstructionError), match=sentence):
        Reconstruct(ReconstructConfig(**settings))(views)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"shared_camera": True, "own_cameras": True}, "own_cameras"),
        ({"camera_model": "SIMPLE_RADAL"}, "camera_model"),
    ],
)
def test_contradictory_or_unknown_settings_are_rejected(settings, field):
    with pytest.raises(ConfigError, match=field):
        ReconstructConfig(**settings)


def test_photographs_are_written_as_srgb_without_padding_with_masks():
    views = blank([(4, 3), (2, 3)])
    images = views.images.clone()
    images[0] = 0.21586  # sRGB 128/255
    images[1, :, :, 2:] = 1.0  # padding must not be written
    masks = torch.zeros(2, 3, 4, dtype=torch.bool)
    masks[:, :, 0] = True
    with workspace(views.replace(images=images, masks=masks), threads=2) as space:
        first, second = (np.asarray(Image.open(space.images / file)) for file in space.files)
        mask = np.asarray(Image.open(space.masks / f"{space.files[1]}.png"))
    assert not space.folder.exists()
    assert first.shape == (3, 4)
    assert (first == 128).all()
    assert second.shape == (3, 2)
    assert (second == 0).all()
    assert mask.tolist() == [[255, 0]] * 3


@pytest.mark.slow
def test_eight_photographs_of_the_skull_are_registered():
    from pimper_torch.io.photographs import load_views

    views = load_views(str(files("pimper_torch").joinpath("data/skull")))
    chosen = [views.names.index(f"{number}.jpg") for number in (46, 47, 48, 49, 60, 62, 63, 64)]
    with collected(Progress) as events:
        scene = Reconstruct(ReconstructConfig(threads=2))(views.take(chosen))
    progress = [(event.done, event.total) for event in events]
    # Two photographs per thread: two steps of extraction, then one tile of pairs; the guided
    # pairs one by one; then the mapper, from its third view. No background search.
    guided = progress[3][1]
    assert 8 < guided <= 8 * 7 // 2
    assert progress[:3] == [(1, 2), (2, 2), (1, 1)]
    assert progress[3 : 3 + guided] == [(done, guided) for done in range(1, guided + 1)]
    assert progress[3 + guided] == (3, 8)
    assert all(done <= total for done, total in progress)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert scene.unregistered == ()
    # The complete set of 66 photographs gives 2048 px at this size, and a distortion of 0.04.
    assert scene.cameras.intrinsics[0, 0, 0] == pytest.approx(2048, rel=0.05)
    assert len(scene.points_world) > 500
    assert scene.reprojection_errors_px.median() < 1


@pytest.mark.slow
@pytest.mark.parametrize("small", [66, 4], ids=["few", "many"])
def test_the_same_photographs_give_the_same_bits_on_any_number_of_threads(small, monkeypatch):
    from pimper_torch.io.photographs import load_views

    for module in (retrieval, track_observations, registration):
        monkeypatch.setattr(module, "MOST_PAIRED", small)
    monkeypatch.setattr(retrieval, "_NEIGHBOURS", 3)
    views = load_views(str(files("pimper_torch").joinpath("data/skull")), max_size_px=600)
    chosen = (19, 36, 37, 39, 52, 54, 56)
    some = views.take([views.names.index(f"{number}.jpg") for number in chosen])
    found = {
        digest(structure_from_motion(some, ReconstructConfig(threads=threads)))
        for threads in (1, 2, 2, 2)
    }
    assert len(found) == 1
    assert None not in found


def test_photographs_with_nan_pixels_are_rejected_by_name(views, tmp_path):
    images = views.images.clone()
    images[1, :, 3, 4] = torch.nan
    images[1, 0, 3, 5] = torch.inf
    odd = views.replace(images=images)
    for model in (None, tmp_path):
        with pytest.raises(InputError, match=rf"photographs {views.names[1]} \(2 pixels\); needed"):
            Reconstruct()(odd, model)


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
def test_the_same_photographs_are_reconstructed_once(views, model, tmp_path, monkeypatch):
    runs = []

    def found(views, config):
        runs.append(config)
        return model.replace(background_from_view=torch.eye(3).double().repeat(5, 1, 1))

    monkeypatch.setattr(reconstruct, "structure_from_motion", found)
    first = Reconstruct(cache=tmp_path)(views)
    second = Reconstruct(ReconstructConfig(threads=1), cache=str(tmp_path))(views)
    assert len(runs) == 1
    assert digest(first) == digest(second) is not None
    kept = [find_model(views, ReconstructConfig(), Store(folder=tmp_path)) for _ in range(2)]
    assert kept[0][1] == kept[1][1] > 0  # the seconds of the reconstruction
    Reconstruct(ReconstructConfig(seed=1), cache=tmp_path)(views)
    Reconstruct()(views)
    Reconstruct(cache=tmp_path)(views.replace(masks=views.inside))
    assert len(runs) == 4
