"""Captures of a folder are read one by one, whole, and in processes of a loader."""

import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from photographs import save_photographs
from surfaces import surface_of
from torch.nn.functional import normalize
from torch.testing import assert_close
from torch.utils.data import DataLoader

import pimper_torch as pt
from pimper_bench.datasets import read_rendered
from pimper_bench.scenes import SceneConfig, render_random, render_scene
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visibility import RayCaster

SMALL = SceneConfig(num_views=3, width=64, height=48, supersample=1)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A rendered scene with everything, and photographs with nothing."""
    folder = tmp_path_factory.mktemp("captures")
    render_scene("balls", folder / "balls", SMALL, processes=1)
    save_photographs(render_random(2, num_views=3, width=64, height=48).views, folder / "plain")
    (folder / ".hidden").mkdir()
    (folder / "list.txt").write_text("balls, plain")
    return folder


def test_a_capture_has_what_its_folder_has(root):
    captures = pt.data.Captures(root)
    assert [folder.name for folder in captures.folders] == ["balls", "plain"]
    assert len(captures) == 2
    full, plain = captures
    assert (full.name, plain.name) == ("balls", "plain")
    assert plain.views.num_views == 3
    assert plain.scene is plain.mesh is plain.normals is plain.depth is plain.views.masks is None
    read = pt.load_views(root / "balls" / "photos", masks=root / "balls" / "masks")
    assert torch.equal(full.views.images, read.images)
    assert torch.equal(full.views.masks, read.masks)
    true = read_rendered(root / "balls")
    assert full.scene.views.names == true.views.names
    assert_close(full.scene.cameras.cam_from_world, true.cameras.cam_from_world.float())
    assert len(full.scene.points_world) > 100
    assert_close(full.mesh.vertices_world, true.truth.mesh.vertices_world.float())
    full.scene.check("scene")
    full.normals.check("normals")
    full.depth.check("depth")


def test_the_truth_is_that_of_rays_through_the_pixels(root):
    capture = pt.data.read_capture(root / "balls", max_size_px=32)
    assert capture.scene.cameras.sizes_px.tolist() == [[32, 24]] * 3
    assert capture.normals.sizes_px.tolist() == [[64, 48]] * 3  # the maps keep their size
    cameras = read_rendered(root / "balls", maps=False).cameras
    caster = RayCaster(capture.mesh.vertices_world, capture.mesh.faces)
    true = pt.read_mesh(root / "balls" / "truth" / "mesh.ply").normals_world
    masks = pt.load_views(root / "balls" / "photos", masks=root / "balls" / "masks").masks
    for view in range(3):
        pose = cameras.cam_from_world[view]
        rays = rays_through(pixel_centers(64, 48, like=pose), pose, cameras.intrinsics[view])
        hits = caster.cast(cameras.centers_world[view], rays.reshape(-1, 3))
        inside = masks[view].reshape(-1)
        depth = capture.depth.depth[view].reshape(-1)[inside]
        assert_close(depth, hits.distance[inside].float(), atol=1e-4, rtol=1e-4)
        normals = normalize(hits.interpolate(true, capture.mesh.faces), dim=-1) @ pose[:3, :3].mT
        found = capture.normals.normals[view].reshape(-1, 3)[inside]
        assert_close(found, normals[inside].float(), atol=2e-3, rtol=0)
        assert (capture.normals.variance[view].reshape(-1)[inside] < 1e-6).all()


def test_normals_without_a_negative_component_are_not_taken_for_colours(root, tmp_path):
    folder = shutil.copytree(root / "balls", tmp_path / "balls")
    up = torch.tensor([0.0, 0.0, 1.0])  # towards all cameras
    for path in (folder / "truth" / "maps").iterdir():
        arrays = dict(np.load(path))
        arrays["normals_world"][:] = up.numpy()
        np.savez(path, **arrays)
    capture = pt.data.read_capture(folder)
    expected = capture.scene.cameras.cam_from_world[:, :3, :3] @ up
    assert_close(capture.normals.normals[:, 20, 30], expected, atol=1e-3, rtol=0)


def test_photographs_without_a_true_map_have_no_truth(root, tmp_path):
    folder = shutil.copytree(root / "balls", tmp_path / "balls")
    (folder / "truth" / "maps" / "view_001.npz").unlink()
    whole, capture = pt.data.read_capture(root / "balls"), pt.data.read_capture(folder)
    assert capture.normals.names == capture.depth.names == ("view_000.png", "view_002.png")
    assert torch.equal(capture.normals.normals, whole.normals.normals[[0, 2]])


def test_photographs_of_one_place_under_several_lights_have_a_true_map_each(tmp_path):
    config = replace(SMALL, num_views=6, lights_per_pose=2)
    render_scene("balls", tmp_path / "balls", config, processes=1)
    with pytest.warns(pt.PimperWarning, match="3 camera poses"):
        (capture,) = pt.data.Captures(tmp_path)
    assert capture.views.poses.tolist() == [0, 0, 1, 1, 2, 2]
    assert capture.normals.names == capture.views.names
    assert torch.equal(capture.depth.depth[0], capture.depth.depth[1])


def test_losses_take_the_truth_of_a_capture(root):
    capture = pt.data.read_capture(root / "balls")
    mesh = capture.mesh
    surface = surface_of(mesh.vertices_world, mesh.faces, normals_world=mesh.normals_world)
    assert pt.losses.NormalLoss(capture.normals)(surface, capture.scene) < 0.02
    assert pt.losses.PointToSurfaceLoss(mesh)(surface) < 1e-4


@pytest.mark.parametrize(
    ("context", "workers"),
    [(None, 0), ("fork", 2), pytest.param("spawn", 2, marks=pytest.mark.slow)],
)
def test_a_loader_returns_captures_as_they_are(root, context, workers):
    captures = pt.data.Captures(root, max_size_px=40)
    options = {"num_workers": workers, "multiprocessing_context": context}
    items = DataLoader(captures, batch_size=None, **options)
    for alone, loaded in zip(captures, items, strict=True):
        assert type(loaded) is pt.data.Capture
        assert loaded.name == alone.name
        assert torch.equal(loaded.views.images, alone.views.images)
    (both,) = DataLoader(captures, batch_size=2, collate_fn=list, **options)
    assert [capture.name for capture in both] == ["balls", "plain"]
    assert torch.equal(both[0].depth.depth, captures[0].depth.depth)


def test_captures_survive_pickle_and_nothing_is_read_before(root, tmp_path):
    (tmp_path / "empty").mkdir()
    captures = pickle.loads(pickle.dumps(pt.data.Captures(tmp_path)))
    with pytest.raises(pt.InputError, match=r"empty: this capture cannot be read\. .*no images"):
        captures[0]
    captures = pickle.loads(pickle.dumps(pt.data.Captures(root, max_size_px=40)))
    assert max(captures[1].views.images.shape[-2:]) == 40


def test_other_readers_read_captures(root):
    captures = pt.data.Captures(root, read_rendered, maps=False)
    assert captures[0].truth.depth is None
    assert captures[0].truth.lights_world.shape == (3, 4)
    with pytest.raises(pt.InputError, match=r"plain: this capture cannot be read\. .*scene\.json"):
        captures[1]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("photos/view_001.png", b"\x89PNG", r"view_001\.png"),
        ("masks/view_001.png", None, r"masks: no mask for view_001\.png"),
        ("truth/maps/view_001.npz", b"PK", r"view_001\.npz: cannot be read"),
        ("truth/sparse/images.bin", b"1", "sparse cannot be read"),
        ("truth/mesh.ply", b"ply\n", r"mesh\.ply: cannot be read as a mesh"),
    ],
)
def test_a_damaged_capture_is_named_with_its_fault(root, tmp_path, file, content, message):
    path = shutil.copytree(root / "balls", tmp_path / "balls") / file
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(pt.InputError, match=rf"balls: this capture cannot be read\. .*{message}"):
        pt.data.Captures(tmp_path)[0]


def test_folders_without_captures_are_refused(root, tmp_path):
    for folder, found in (
        (tmp_path / "missing", "nothing"),
        (tmp_path, "nothing"),
        (root / "balls", "masks, photos, truth"),
        (root / "plain", r"view_00\.png"),
    ):
        with pytest.raises(pt.InputError, match=rf"found .*{found}.*needed: a folder in it"):
            pt.data.Captures(folder)
