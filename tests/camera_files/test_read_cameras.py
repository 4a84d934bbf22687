"""One rig in every supported format: `--sparse` reads the same cameras."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import camera_writers as rigs
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch.testing import assert_close

from pimper_torch.export.nerfstudio import write_transforms
from pimper_torch.geometry.undistortion import pinholes_for
from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.io.cameras.transforms_json import read_cloud
from pimper_torch.records import Cameras, Views
from pimper_torch.runtime.errors import InputError, PimperWarning


@pytest.fixture
def rig() -> Cameras:
    return rigs.rig_of(7)


WAYS = [
    rigs.of_colmap,
    lambda rig, folder: rigs.of_colmap(rig, folder, text=True),
    rigs.of_transforms,
    rigs.of_metashape,
    rigs.of_meshroom,
    rigs.of_sfm_json,
    rigs.of_polycam,
    rigs.of_idr,
    rigs.of_matrices,
    rigs.of_named_poses,
    rigs.of_projections,
]


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**31))
@pytest.mark.parametrize("write", WAYS)
def test_every_format_gives_the_written_cameras(write, seed):
    rig = rigs.rig_of(seed)
    with TemporaryDirectory() as folder:
        found = existing_model(rigs.views_of(), write(rig, Path(folder)))
    assert found.names == rigs.NAMES
    order = torch.tensor(
        np.argsort(rigs.NAMES) if write in (rigs.of_matrices, rigs.of_projections) else range(3)
    )
    # Arrays without names have the order of sorted names, which is not that of the rig.
    expected = rig.take(torch.argsort(order))
    assert_close(found.cam_from_world, expected.cam_from_world, rtol=0, atol=1e-6)
    assert_close(pinholes_for(found.lenses), expected.intrinsics, rtol=0, atol=1e-6)
    assert [(lens.width, lens.height) for lens in found.lenses] == [(rigs.WIDTH, rigs.HEIGHT)] * 3


@pytest.mark.parametrize("text", [False, True])
def test_the_largest_of_several_models_is_read(rig, text, tmp_path):
    for number, names in (("0", ("2.png",)), ("1", rigs.NAMES), ("10", ("x.png", "10.png"))):
        cameras = rig.take(torch.arange(len(names)))
        rigs.of_colmap(cameras, tmp_path, text=text, names=names).rename(tmp_path / number)
    message = r"3 COLMAP models, .*The largest, 1, is used, not 0, 10\. To use another one"
    with pytest.warns(PimperWarning, match=message):
        found = existing_model(rigs.views_of(), tmp_path)
    assert found.names == rigs.NAMES
    assert_close(found.cam_from_world, rig.cam_from_world, rtol=0, atol=1e-6)
    # A single model is read without a warning, from its folder or one above.
    (tmp_path / "0").rename(tmp_path / "1" / "old")
    assert existing_model(rigs.views_of(), tmp_path / "1").names == rigs.NAMES
    (tmp_path / "10").rename(tmp_path / "1" / "older")
    assert existing_model(rigs.views_of(), tmp_path).names == rigs.NAMES


@pytest.mark.parametrize(
    "write", [rigs.of_colmap, rigs.of_metashape, rigs.of_meshroom, rigs.of_transforms]
)
def test_cameras_are_scaled_with_resized_photographs(rig, write, tmp_path):
    found = existing_model(rigs.views_of(0.5), write(rig, tmp_path))
    K = pinholes_for(found.lenses)
    assert_close(K[:, :2], rig.intrinsics[:, :2] / 2, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "write",
    [
        rigs.of_matrices,
        rigs.of_idr,
        lambda rig, folder: rigs.of_transforms(rig, folder, sizes=False),
    ],
)
def test_a_file_without_sizes_refers_to_the_sizes_of_the_photograph_files(rig, write, tmp_path):
    photographs = tmp_path / "photos"
    photographs.mkdir()
    for name in rigs.NAMES:
        Image.new("L", (rigs.WIDTH, rigs.HEIGHT)).save(photographs / name)
    found = existing_model(rigs.views_of(0.5, photographs), write(rig, tmp_path))
    K = pinholes_for(found.lenses)
    assert_close(K[:, :2], rig.intrinsics[:, :2] / 2, rtol=0, atol=1e-6)


def test_a_file_without_sizes_does_not_refer_to_raw_previews(rig, tmp_path):
    for name in rigs.NAMES:  # Pillow reads the first image of a NEF, of 160 x 120
        Image.new("L", (rigs.WIDTH // 4, rigs.HEIGHT // 4)).save(tmp_path / name)
    found = existing_model(rigs.views_of(1.0, tmp_path), rigs.of_matrices(rig, tmp_path))
    assert_close(pinholes_for(found.lenses), rig.intrinsics, rtol=0, atol=1e-6)


@pytest.mark.parametrize("suffix", [".CR2", ".dng", ".heic"])
def test_a_model_of_jpegs_matches_raw_photographs_of_the_same_names(rig, suffix, tmp_path):
    jpegs = tuple(name.replace(".png", ".JPG") for name in rigs.NAMES)
    views = rigs.views_of().replace(
        names=tuple(name.replace(".png", suffix) for name in rigs.NAMES)
    )
    found = existing_model(views, rigs.of_colmap(rig, tmp_path, names=jpegs))
    assert found.names == views.names
    assert_close(found.cam_from_world, rig.cam_from_world, rtol=0, atol=1e-6)


def of_poses() -> Views:
    """Photographs under two lights each, in folders named like those of the rig."""
    views = rigs.views_of()
    poses = torch.arange(3).repeat_interleave(2)
    names = [
        f"{Path(rigs.NAMES[pose]).stem}/light {light}.png" for pose in range(3) for light in "xy"
    ]
    return views.take(poses.tolist()).replace(names=tuple(names), poses=poses)


@pytest.mark.parametrize("write", WAYS)
def test_one_camera_per_folder_applies_to_every_light_of_the_pose(rig, write, tmp_path):
    found = existing_model(of_poses(), write(rig, tmp_path))
    assert found.names == of_poses().names
    every = rig.take(torch.arange(3).repeat_interleave(2))
    assert_close(found.cam_from_world, every.cam_from_world, rtol=0, atol=1e-6)
    assert_close(pinholes_for(found.lenses), every.intrinsics, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ("10/light y.png", "2/light x.png", "a b/light_x.jpg"),
        ("photos/10/mean.png", "photos/2/mean.png", "photos/a_b/mean.png"),
        ("10/light x.png", "2.jpg", "A B/sum.png"),
    ],
)
def test_the_camera_of_any_image_of_a_pose_applies_to_all_its_lights(rig, names, tmp_path):
    found = existing_model(of_poses(), rigs.of_colmap(rig, tmp_path, names=names))
    every = rig.cam_from_world.repeat_interleave(2, dim=0)
    assert_close(found.cam_from_world, every, rtol=0, atol=1e-6)


def test_a_skew_is_refused_and_its_rounding_is_not(rig, tmp_path):
    K = rig.intrinsics.clone()
    K[:, 0, 1] = 1e-3
    existing_model(rigs.views_of(), rigs.of_matrices(rig.replace(intrinsics=K), tmp_path))
    K[1, 0, 1] = 3.0
    skewed = rigs.of_projections(rig.replace(intrinsics=K), tmp_path)
    with pytest.raises(InputError, match=r"cameras\.npz: found a skew in 2\.png"):
        existing_model(rigs.views_of(), skewed)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"K": np.eye(3)}, "projections.*Found: K"),
        ({}, "no arrays"),
        ({"P": np.zeros((3, 3, 4))}, "no inverse"),
        ({"P": np.zeros((3, 4, 3))}, "3x4 numbers per camera as P"),
        ({"K": np.eye(3), "R": [np.eye(3)] * 3, "t": np.zeros((2, 3))}, "as many R as t"),
        ({"K": np.eye(3), "cam_from_world": np.zeros((3, 3, 4))}, "a rotation in"),
        ({"K": -np.eye(3), "cam_from_world": [np.eye(4)] * 3}, "as K 0"),
        ({"K": np.eye(3), "cam_from_world": [np.eye(4)] * 2}, "3 photographs.*2 cameras"),
        ({"K": np.eye(3), "cam_from_world": np.full((3, 3, 4), np.nan)}, "finite numbers"),
        ({"world_mat_0": np.eye(4), "world_mat_1": np.eye(4)}, "3 photographs.*2 cameras"),
    ],
)
def test_invalid_camera_arrays_are_refused(arrays, message, tmp_path):
    with pytest.raises(InputError, match=message):
        existing_model(rigs.views_of(), rigs.saved(tmp_path, **arrays))


@pytest.mark.parametrize("name", ["cameras.txt", "cameras.json", "cameras.xml", "cameras.npz"])
def test_an_unknown_file_is_refused(name, tmp_path):
    (tmp_path / name).write_text("nothing of the kind")
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        existing_model(rigs.views_of(), tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", {"views": 1, "lens": 2}, r"but has views, lens; needed: .*cameras\.sfm \("),
        ("a.sfm", {"root": 1}, "is not a camera file, but has root; needed: "),
        ("metadata", {"dw": 192}, "is not a camera file, but has dw; needed: .*metadata \\(Record"),
        (
            "sfm_data.json",
            {"sfm_data_version": "0.3", "views": [], "intrinsics": [], "extrinsics": []},
            "has sfm_data_version, views, .* OpenMVG makes a COLMAP model by `openMVG_main",
        ),
        (
            "reconstruction.json",
            [{"cameras": {}, "shots": {}, "points": {}}],
            "has cameras, shots, points; needed: .* OpenSfM makes a COLMAP model by `opensfm",
        ),
    ],
)
def test_json_of_an_unknown_program_is_refused_with_its_keys(name, content, message, tmp_path):
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        existing_model(rigs.views_of(), tmp_path / name)


@pytest.mark.parametrize(
    "columns", ["x,y,z", "x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
)
def test_tables_of_realitycapture_are_refused_with_the_way_to_a_model(columns, tmp_path):
    path = tmp_path / "registration.csv"
    path.write_text(f"#name,{columns}\n")
    message = "has #name, x, y, .*; needed: .* RealityCapture exports COLMAP models, which define"
    with pytest.raises(InputError, match=message):
        existing_model(rigs.views_of(), path)


@pytest.mark.parametrize("content", [b"\xff\xd8", b"nothing of the kind"])
def test_a_file_without_suffix_that_is_not_json_is_refused(content, tmp_path):
    (tmp_path / "metadata").write_bytes(content)
    with pytest.raises(InputError, match="metadata: cannot be read as JSON in UTF-8"):
        existing_model(rigs.views_of(), tmp_path / "metadata")


def test_a_folder_of_json_without_a_model_stands_for_its_first_file(rig, tmp_path):
    path = rigs.of_transforms(rig, tmp_path)
    assert existing_model(rigs.views_of(), tmp_path).names == rigs.NAMES
    (tmp_path / "a.json").write_text('{"lens": []}')
    with pytest.raises(InputError, match=r"a\.json: is not a camera file, but has lens"):
        existing_model(rigs.views_of(), tmp_path)
    # A model in the folder, or in one of its folders, counts first.
    rigs.of_colmap(rig, tmp_path)
    assert existing_model(rigs.views_of(), tmp_path).names == rigs.NAMES
    assert path.is_file()


def test_two_cameras_of_one_photograph_are_refused(rig, tmp_path):
    pose = rig.cam_from_world
    path = rigs.saved(tmp_path, K=rig.intrinsics[0], cam_from_world=pose, names=["2.png"] * 3)
    with pytest.raises(InputError, match=r"2\.png may be any of 2\.png, 2\.png"):
        existing_model(rigs.views_of(), path)


def test_the_point_cloud_of_a_camera_file_is_read(rig, tmp_path):
    cloud = torch.randn(7, 3, generator=torch.Generator().manual_seed(71)).double()
    write_transforms(rigs.views_of(), rig, tmp_path, points_world=cloud)
    found = existing_model(rigs.views_of(), tmp_path / "transforms.json")
    assert_close(found.points_world, cloud, rtol=0, atol=1e-6)
    assert len(found.observation_point) == 0


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("../cloud.ply", "leads out of it"),
        ("/etc/passwd", "leads out of it"),
        ("broken.ply", "cannot be read as a PLY file"),
    ],
)
def test_a_cloud_that_cannot_be_read_is_refused(rig, tmp_path, name, why):
    path = rigs.of_transforms(rig, tmp_path)
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    path.write_text(json.dumps({**json.loads(path.read_text()), "ply_file_path": name}))
    with pytest.raises(InputError, match=why):
        read_cloud(path)


def test_a_missing_cloud_gives_a_warning(rig, tmp_path):
    path = rigs.of_transforms(rig, tmp_path)
    assert len(read_cloud(path)) == 0
    path.write_text(json.dumps({**json.loads(path.read_text()), "ply_file_path": "gone.ply"}))
    with pytest.warns(PimperWarning, match=r"names the point cloud gone\.ply, which does not"):
        assert len(read_cloud(path)) == 0


def test_points_that_are_not_finite_are_removed_from_a_cloud(rig, tmp_path):
    cloud = torch.tensor([[1.0, 2, 3], [torch.nan, 0, 0], [4, 5, 6]]).double()
    write_transforms(rigs.views_of(), rig, tmp_path, points_world=cloud)
    assert read_cloud(tmp_path / "transforms.json").tolist() == [[1, 2, 3], [4, 5, 6]]
