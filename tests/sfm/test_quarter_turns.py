import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.quarter_turns import turned_lens, turned_pixels, turned_pose
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.cameras.model_files import camera_models
from pimper_torch.records import CameraModel

COUNTS = dict(camera_models().values())


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("model", sorted(COUNTS.keys() - {"EQUIRECTANGULAR"}))
def test_a_turned_camera_projects_to_the_turned_image(model, quarters, generator):
    count = COUNTS[model]
    one_focal = model.startswith(("SIMPLE_", "RADIAL"))
    start = (90.0, 41.0, 29.0) if one_focal else (90.0, 97.0, 41.0, 29.0)
    rest = 0.01 * (1 + torch.rand(count - len(start), generator=generator, dtype=torch.float64))
    if model == "EUCM":
        rest = torch.tensor([0.6, 1.1])
    lens = CameraModel(camera=3, model=model, params=(*start, *rest.tolist()), width=80, height=60)
    points = torch.rand(50, 3, generator=generator, dtype=torch.float64) - 0.5
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 2.0])
    before = distort(lens, transform(pose, points))
    after = distort(turned_lens(lens, quarters), transform(turned_pose(pose, quarters), points))
    assert_close(after, turned_pixels(before, 80, 60, quarters), rtol=0, atol=1e-9)
    assert before.isfinite().all()


def test_pixels_of_an_image_turned_by_torch_are_mapped_correctly(generator):
    picture = torch.rand(6, 8, generator=generator)
    centers = torch.cartesian_prod(torch.arange(6.0), torch.arange(8.0)).flip(1) + 0.5
    for quarters in range(-1, 5):
        moved = turned_pixels(centers, 8, 6, quarters)
        column, row = (moved - 0.5).long().unbind(dim=1)
        turned = torch.rot90(picture, -quarters)  # counterclockwise
        assert torch.equal(turned[row, column], picture.reshape(-1))
