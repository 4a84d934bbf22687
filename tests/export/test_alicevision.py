import json

import torch
from torch.testing import assert_close

from pimper_bench.datasets import read_camera_file
from pimper_torch.export.alicevision import write_alicevision, write_sfm
from pimper_torch.geometry.lens_models import pinhole_of
from pimper_torch.io.cameras.meshroom_sfm import read_meshroom
from pimper_torch.viz.maps import view_maps


def parsed(path):
    return json.loads(path.read_text())


def test_an_export_survives_a_round_trip(result, tmp_path, same_cameras):
    write_alicevision(result, tmp_path)
    found = read_camera_file(tmp_path / "cameras.sfm", masks=tmp_path / "masks")
    same_cameras(found.cameras, result.cameras)
    assert found.views.names == result.scene.views.names
    assert torch.equal(found.views.masks, result.silhouettes.masks)


def test_pinholes_of_different_focal_lengths_and_sizes_are_read_back(result, tmp_path):
    K = torch.tensor(
        [[[20.0, 0, 7], [0, 30, 5], [0, 0, 1]], [[21, 0, 6.25], [0, 19, 4.5], [0, 0, 1]]]
    )
    sizes = torch.tensor([[16, 12], [13, 9]])
    cameras = result.cameras.take([0, 1]).replace(intrinsics=K.double(), sizes_px=sizes)
    write_sfm(cameras, ["a.png", "b.png"], tmp_path / "x.sfm")
    found = read_meshroom(tmp_path / "x.sfm")
    pinholes = torch.stack([pinhole_of(one.lens) for one in found])
    assert_close(pinholes, cameras.intrinsics, rtol=0, atol=1e-9)
    assert [[one.lens.width, one.lens.height] for one in found] == sizes.tolist()


def test_maps_are_named_by_the_views(result, tmp_path):
    write_alicevision(result, tmp_path)
    cameras = parsed(tmp_path / "cameras.sfm")
    for name in ("normalMaps", "albedoMaps", "masks"):
        other = parsed(tmp_path / f"{name}.sfm")
        for key in ("intrinsics", "poses"):
            assert other[key] == cameras[key]
        assert [one["viewId"] for one in other["views"]] == ["1", "2", "3"]
        assert all((tmp_path / one["path"]).is_file() for one in other["views"])


def test_normals_are_rotated_to_the_world_of_open_rnb(result, tmp_path, read_exr):
    """Its world and camera axes are those of AliceVision with y and z negated."""
    write_alicevision(result, tmp_path)
    whole = parsed(tmp_path / "normalMaps.sfm")
    flip = torch.tensor([1.0, -1, -1])
    for view, (one, pose) in enumerate(zip(whole["views"], whole["poses"], strict=True)):
        numbers = [float(text) for text in pose["pose"]["transform"]["rotation"]]
        cam2world = flip[:, None] * torch.tensor(numbers).reshape(3, 3) * flip
        normals = torch.from_numpy(read_exr(tmp_path / one["path"]))
        found = flip * (normals @ cam2world.T)
        maps = view_maps(result.mesh, result.scene.cameras, view)
        rotation = result.scene.cameras.cam_from_world[view, :3, :3]
        assert_close(found, maps.normals_cam @ rotation, rtol=0, atol=1e-6)
        assert (found[maps.seen][:, 2] > 0).all()  # the bump faces up


def test_albedo_is_linear_and_at_most_one(result, tmp_path, read_exr):
    write_alicevision(result, tmp_path)
    maps = view_maps(result.mesh, result.scene.cameras, 1)
    found = torch.from_numpy(read_exr(tmp_path / "albedos" / "b.exr"))
    assert 0.5 < float(found.max()) <= 1
    ratio = found[maps.seen] / maps.albedo[maps.seen]
    assert_close(ratio[found[maps.seen] < 1].std(), torch.tensor(0.0), rtol=0, atol=1e-5)


def test_an_intrinsic_has_the_fields_of_alicevision(result, tmp_path):
    write_alicevision(result, tmp_path)
    whole = parsed(tmp_path / "cameras.sfm")
    assert whole["version"] == ["1", "2", "8"]
    (first, *_) = whole["intrinsics"]
    # From `compatibilityData/scene_v1.2.8.json` in AliceVision's sources.
    assert set(first) == {
        *("intrinsicId", "width", "height", "sensorWidth", "sensorHeight", "serialNumber", "type"),
        *("initializationMode", "initialFocalLength", "focalLength", "pixelRatio", "locked"),
        *("pixelRatioLocked", "principalPoint", "distortionInitializationMode", "distortionType"),
        *("distortionParams", "undistortionOffset", "undistortionParams", "undistortionType"),
    }
    texts = [
        first["focalLength"],
        *first["principalPoint"],
        *whole["poses"][0]["pose"]["transform"]["center"],
    ]
    assert all(isinstance(text, str) for text in texts)
