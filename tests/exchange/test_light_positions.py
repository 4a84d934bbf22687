import pytest
import torch
from torch.testing import assert_close

from pimper_torch.doors.exchange.layouts import write_lights
from pimper_torch.runtime.errors import InputError


def read_lp(path):
    """Read a file as RTIBuilder does: a count, then names and directions."""
    first, *lines = path.read_text().splitlines()
    assert int(first) == len(lines)
    words = [line.split() for line in lines]
    return {name: torch.tensor([float(x), float(y), float(z)]) for name, x, y, z in words}


def test_directions_are_those_that_the_reference_camera_sees(result, tmp_path):
    # From its front, its right and from above, in the frame of the reference camera.
    rotation = result.cameras.cam_from_world[1, :3, :3]
    seen = torch.tensor([[0.0, 0, -2], [3, 0, 0], [0, -1, 0]]).double()
    lights = torch.cat([torch.ones(3, 1).double(), seen @ rotation], dim=1)
    write_lights(result.replace(lights_world=lights, reference="b.png"), tmp_path)
    found = read_lp(tmp_path / "lights.lp")
    assert_close(found["a.png"], torch.tensor([0.0, 0, 1]))
    assert_close(found["b.png"], torch.tensor([1.0, 0, 0]))
    assert_close(found["c.png"], torch.tensor([0.0, 1, 0]))


def test_lights_without_a_direction_are_left_out_and_blanks_split_no_line(result, tmp_path):
    views = result.scene.views.replace(names=("a.png", "b b.png", "c.png"))
    lights = torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 1], [torch.nan] * 4]).double()
    scene = result.scene.replace(views=views)
    write_lights(result.replace(scene=scene, lights_world=lights, reference="a.png"), tmp_path)
    assert list(read_lp(tmp_path / "lights.lp")) == ["b_b.png"]


@pytest.mark.parametrize("lights", [None, torch.zeros(3, 4).double()])
def test_a_result_that_tells_no_light_is_refused(result, tmp_path, lights):
    with pytest.raises(InputError, match="no view's light has a direction"):
        write_lights(result.replace(lights_world=lights), tmp_path)
