"""From photographs with two known points to a result in real units."""

import json
import logging

import pytest
import torch

from pimper_bench.datasets.rendered import read_rendered
from pimper_torch.cli.main import main
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.cameras.model_files import read_model

log = logging.getLogger(__name__)
SIZE = {"width": 640, "height": 480}


def ends(capture, view):
    """Return two distant pixels of the object in a view, and their points in space."""
    truth, cameras = capture.truth, capture.cameras.to(torch.float64)
    pixels = pixel_centers(SIZE["width"], SIZE["height"], like=cameras.intrinsics)
    depth = truth.depth[view].double()
    # Away from its border, where depth changes from pixel to pixel.
    inner = -torch.nn.functional.max_pool2d(
        -truth.foreground[view][None].float(), 31, stride=1, padding=15
    )[0]
    rows, columns = (inner > 0.5).nonzero().unbind(dim=1)
    order = columns.argsort()
    rows, columns = rows[order[[0, -1]]], columns[order[[0, -1]]]
    chosen = pixels[rows, columns]
    rays = rays_through(chosen, cameras.cam_from_world[view], cameras.intrinsics[view])
    points = cameras.centers_world[view] + depth[rows, columns][:, None] * rays
    seen = transform(cameras.cam_from_world[view], points)[:, 2]
    torch.testing.assert_close(seen, depth[rows, columns], rtol=1e-4, atol=1e-4)
    return chosen, points


def centers(poses):
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].double()


@pytest.mark.slow
def test_two_marks_on_a_rendered_object_give_the_scale(tmp_path, capsys):
    """With the true cameras, so a scene unit is exactly a thousand millimetres."""
    scene, out = tmp_path / "scene", tmp_path / "out"
    sizes = [word for name, value in SIZE.items() for word in (f"--{name}", str(value))]
    assert main(["render", "potatoes", "-o", str(scene), "--num-views", "12", *sizes]) == 0
    capture = read_rendered(scene)
    view = 5
    (first, second), points = ends(capture, view)
    name = capture.views.names[view]
    length = 1000 * float((points[0] - points[1]).norm())
    words = [f"{name},{first[0]:g},{first[1]:g}", f"{name},{second[0]:g},{second[1]:g}"]
    line = ["reconstruct", str(scene / "photos"), "-o", str(out)]
    line += ["--sparse", str(scene / "truth" / "sparse"), "--masks", str(scene / "masks")]
    assert main([*line, "--scale-bar", *words, f"{length:.9g}"]) == 0
    assert "hardly determine" not in capsys.readouterr().err
    scale = json.loads((out / "summary.json").read_text())["scale"]
    assert (scale["unit"], scale["source"]) == ("mm", "scale bars")
    log.info("potatoes: size off by %.2e", scale["factor"] / 1000 - 1)
    assert scale["factor"] == pytest.approx(1000, rel=2e-3)
    found = read_model(out / "sparse")
    true = capture.cameras.take([capture.views.names.index(name) for name in found.names])
    apart = torch.pdist(centers(found.cam_from_world)), torch.pdist(centers(true.cam_from_world))
    assert float((apart[0] / apart[1]).median()) == pytest.approx(scale["factor"], rel=1e-5)
