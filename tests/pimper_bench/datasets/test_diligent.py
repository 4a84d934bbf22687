import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.datasets.diligent import read_diligent_mv
from pimper_torch.geometry.projection import project
from pimper_torch.runtime.errors import InputError

WIDTH, HEIGHT = 20, 16
# In the sets' axes (x right, y up, z to the viewer): from the right, from above, frontal.
DIRECTIONS = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
INTENSITIES = np.array([[0.5, 1.0, 2.0], [1.0, 1.0, 1.0], [3.0, 2.0, 1.0]])


@pytest.fixture
def viewpoint(paint_deep):
    """Write one viewpoint in the format of DiLiGenT; its normals point diagonally up."""

    def write(folder, *, named: bool = True) -> None:
        names = [f"{point_light:03d}.png" for point_light in (1, 2, 3)]
        for point_light, name in enumerate(names, start=1):
            paint_deep(folder / name, (6000 * point_light, 3000 * point_light, 1000), WIDTH, HEIGHT)
        if named:
            (folder / "filenames.txt").write_text("\n".join(names) + "\n")
        np.savetxt(folder / "light_directions.txt", DIRECTIONS)
        np.savetxt(folder / "light_intensities.txt", INTENSITIES)
        mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        mask[4:12, 5:15] = 255
        Image.fromarray(mask).save(folder / "mask.png")
        normals = np.zeros((HEIGHT, WIDTH, 3))
        normals[mask > 0] = [0.0, 0.6, 0.8]
        scipy.io.savemat(folder / "Normal_gt.mat", {"Normal_gt": normals})

    return write


@pytest.fixture
def turntable(tmp_path, rig, viewpoint):
    """Write an object of DiLiGenT-MV with slightly scaled rotations, as published."""
    arrays = {"KK": rig.intrinsics[0].numpy().copy()}
    arrays["KK"][:2, 2] -= 0.5
    for view in (1, 2, 3):
        viewpoint(tmp_path / f"view_{view:02d}", named=view != 2)
        pose = rig.cam_from_world[view - 1].numpy()
        arrays[f"Rc_{view}"] = np.diag([1.003458, 1, 1]) @ pose[:3, :3]
        arrays[f"Tc_{view}"] = pose[:3, 3:]
    scipy.io.savemat(tmp_path / "Calib_Results.mat", arrays)
    return tmp_path


def test_views_and_lights_are_separated_and_points_project_as_in_the_files(turntable, rig):
    capture = read_diligent_mv(turntable)
    assert capture.position.tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert capture.light.tolist() == [1, 2, 3] * 3
    assert capture.views.names[3] == "view_02/001.png"
    assert_close(
        capture.views.images[4, :, 0, 0], torch.tensor([12000.0, 6000, 1000]) / 65535
    )  # linear, at full depth
    point = torch.tensor([[0.03, -0.02, 0.05]], dtype=torch.float64)
    stretch = torch.diag(torch.tensor([1.003458, 1, 1], dtype=torch.float64))
    pose = rig.cam_from_world[1]
    image = rig.intrinsics[0] @ (stretch @ pose[:3, :3] @ point[0] + pose[:3, 3])
    found, depth = project(
        point.float(), capture.cameras.cam_from_world[3], capture.cameras.intrinsics[3]
    )
    assert_close(found[0], (image[:2] / image[2]).float(), atol=2e-3, rtol=0)
    assert (depth > 0).all()
    rotation = capture.cameras.cam_from_world[:, :3, :3]
    assert_close(rotation @ rotation.mT, torch.eye(3).expand(9, 3, 3))


def test_lights_and_normals_are_rotated_to_the_world_frame(turntable, rig):
    capture = read_diligent_mv(turntable, positions=[3])
    lights = capture.truth.lights_world
    toward_camera = normalize(rig.centers_world[2].float(), dim=0)
    # Light 3 is at the camera, light 2 above it: up is -y in our camera.
    assert_close(normalize(lights[2, 1:], dim=0), toward_camera, atol=0.01, rtol=0)
    up = -rig.cam_from_world[2, 1, :3].float()
    assert_close(lights[1, 1:] @ up, torch.tensor(0.6), atol=0.01, rtol=0)
    right = rig.cam_from_world[2, 0, :3].float()
    assert_close(normalize(lights[0, 1:], dim=0) @ right, torch.tensor(0.6), atol=0.01, rtol=0)
    assert_close(lights[:, 1:].norm(dim=1), torch.tensor([3.5 / 3, 1.0, 2.0]))
    normal = capture.truth.normals_world[0, 8, 8]
    assert_close(normal @ up, torch.tensor(0.6), atol=0.01, rtol=0)
    assert_close(normal @ toward_camera, torch.tensor(0.8), atol=0.01, rtol=0)
    assert capture.truth.normals_world[0, 0, 0].tolist() == [0, 0, 0]
    assert capture.views.masks[0].sum() == 80


def test_one_light_per_view_is_read_at_reduced_size(turntable):
    capture = read_diligent_mv(turntable, light_seed=2, max_size_px=10)
    assert capture.position.tolist() == [1, 2, 3]
    assert sorted(capture.light.tolist()) == [1, 2, 3]
    assert capture.truth.normals_world.shape == (3, 8, 10, 3)
    assert capture.views.masks.shape == (3, 8, 10)
    full = read_diligent_mv(turntable, light_seed=2).cameras.intrinsics
    assert_close(2 * capture.cameras.intrinsics[:, :2], full[:, :2])


def _saying(name, text):
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda folder: (folder / "view_02" / "mask.png").unlink(), r"mask\.png: does not exist"),
        (_saying("view_02/light_directions.txt", "1 0 0\n"), r"view_02: .*Found: 1, 1 and 3"),
        (_saying("view_01/filenames.txt", "../a 002.png 003.png"), r"'\.\./a', which leads out"),
        (lambda folder: (folder / "Calib_Results.mat").unlink(), r"Calib_Results\.mat"),
        (
            lambda folder: [path.rename(folder / path.name[5:]) for path in folder.glob("view_*")],
            r"view_01, view_02.*Found: 01, 02, 03",
        ),
    ],
)
def test_a_different_layout_is_refused_with_expected_and_found_files(turntable, break_it, message):
    break_it(turntable)
    with pytest.raises(InputError, match=message):
        read_diligent_mv(turntable)
