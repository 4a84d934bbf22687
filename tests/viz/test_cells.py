"""Records in cells of notebooks: a small picture and a table."""

import re
from base64 import b64decode
from html import unescape
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import normalize

from pimper_torch.chains.chain import Step
from pimper_torch.geometry.rigid import rotate
from pimper_torch.records import Verdict
from pimper_torch.viz.overview import framed, overview

IMAGE = re.compile(r"data:image/(?:png|jpeg);base64,([A-Za-z0-9+/=]+)")


def images(html):
    """Decode all images of a cell."""
    files = (BytesIO(b64decode(data)) for data in IMAGE.findall(html))
    return [np.asarray(Image.open(file).convert("RGB")) for file in files]


def small(html):
    """Check that a cell loads nothing and is small, and return it without its images."""
    text = IMAGE.sub("", html)
    assert not re.search(r"https?:|src=[\"']?(?!\")[a-z]", text)
    assert len(html) < 500_000
    return text


@pytest.mark.parametrize("masks", [False, True])
def test_views_show_a_thumbnail_of_each(reconstruction, masks):
    views = reconstruction.scene.views
    inside = torch.zeros(views.num_views, 40, 60, dtype=torch.bool)
    inside[:, 10:30, 20:40] = True
    grey = views.replace(images=torch.full_like(views.images, 0.2))
    html = grey.replace(masks=inside if masks else None)._repr_html_()
    (picture,) = images(html)
    assert picture.shape == (round(640 / 8 * 40 / 60), 640, 3)
    assert (np.ptp(picture, axis=-1) > 40).any() == masks  # outlines have a colour
    assert "<th>names</th><td>(&#x27;a.png&#x27;" in small(html)


def test_a_scene_shows_its_cloud_or_its_photographs(reconstruction):
    scene = reconstruction.scene
    cloud = torch.cartesian_prod(*3 * [torch.linspace(-0.5, 0.5, 4)])
    many = scene.replace(
        points_world=cloud,
        reprojection_errors_px=cloud[:, 0],
        observation_point=scene.observation_point[:0],
        observation_view=scene.observation_view[:0],
        observation_pixels=scene.observation_pixels[:0],
    )
    html = many._repr_html_()
    (picture,) = images(html)
    assert picture.shape[0] == 180
    assert "<th>points_world</th><td>float32[64, 3]</td>" in small(html)
    none = many.replace(points_world=cloud[:0], reprojection_errors_px=cloud[:0, 0])
    assert "Views(view 3" in small(none._repr_html_())


def test_a_result_is_lit_by_its_normals_and_albedo(reconstruction):
    """Those of a plate, in the camera's frame, are the same in all of its pixels."""
    mesh = reconstruction.mesh
    flat = mesh.vertices_world * torch.tensor([1.0, 1, 0])
    up = torch.tensor([0.0, 0, 1]).expand_as(flat)
    grey = torch.full_like(flat, 0.5)
    plate = reconstruction.replace(
        mesh=mesh.replace(vertices_world=flat, normals_world=up, albedo=grey),
        verdict=Verdict(score=1.0, text="Good: <b>bold</b>.", scores={}),
    )
    html = plate._repr_html_()
    page = unescape(re.search(r'srcdoc="([^"]*)"', html)[1])
    normals, albedo = images(page)
    size = framed(plate.cameras.take([1]), flat, 320).sizes_px[0].tolist()
    assert [normals.shape[1], normals.shape[0]] == size
    wanted = rotate(plate.cameras.cam_from_world[1], normalize(up[:1], dim=1))[0]
    found = torch.tensor(normals[normals.shape[0] // 2, normals.shape[1] // 2]) / 127.5 - 1
    assert (found * torch.tensor([1, -1, -1]) - wanted).abs().max() < 1 / 127.5
    assert (normals == normals[len(normals) // 2, normals.shape[1] // 2]).all(-1).mean() > 0.5
    assert albedo.shape == normals.shape
    text = small(html)
    assert "sandbox" in text
    assert "Good: &lt;b&gt;bold" in text
    assert "<b>bold" not in text
    assert 'id="lamp"' in page


def test_records_without_a_picture_keep_their_text(reconstruction):
    assert reconstruction.mesh._repr_html_() is None
    assert reconstruction.silhouettes._repr_html_() is None


def step_of(reconstruction):
    """A step with the parts of a result, unchecked."""
    step = object.__new__(Step)
    values = {"prepared": reconstruction, "surface": reconstruction, "scale": 0.5, "last": False}
    values |= {"heights": reconstruction.patches, "reports": (), "failures": (), "left_out": ()}
    for name, value in values.items():
        object.__setattr__(step, name, value)
    return step


def test_a_step_shows_its_surface(reconstruction):
    step = step_of(reconstruction)
    (picture,) = images(html := step._repr_html_())
    assert picture.shape[0] == 180
    assert "<th>scale</th><td>0.5</td>" in small(html)


def test_plot_is_the_contact_sheet(reconstruction):
    assert reconstruction.plot().tobytes() == overview(reconstruction).tobytes()


def test_records_with_gradients_are_drawn(reconstruction):
    mesh, scene = reconstruction.mesh, reconstruction.scene
    for tensor in (mesh.vertices_world, mesh.albedo, scene.cameras.cam_from_world):
        tensor.requires_grad_()
    scene.views.images.requires_grad_()
    step = step_of(reconstruction)
    for record in (reconstruction, step, scene, scene.views):
        assert images(unescape(record._repr_html_()))
    assert reconstruction.plot().width > 500
