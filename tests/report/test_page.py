import base64
import json
import math
import re
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import CORNERS, FACETS
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.visibility import visible_vertices
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Materials, Mesh, Relighting, ViewErrors, ViewLights
from pimper_torch.viz.report.openness import openness
from pimper_torch.viz.report.page import left_out_by_pass, write_page
from pimper_torch.viz.report.predictions import (
    Prediction,
    jpeg,
    longest_px,
    outline,
    predictions,
    shrunk_to,
    view_entries,
    view_images,
)
from pimper_torch.viz.report.vertex_layers import (
    VertexLayer,
    length_layer,
    length_unit,
    surface_layers,
)

MATTE = (0.0, 1.0, 0.0)  # metallic, roughness, specular
SUMMARY = {
    "photographs": "/home/somebody/cup",
    "diagnosis": None,
    "warnings": ["two photographs are blurred; take them again"],
    "seconds": 12.0,
    "stages": [],
    "left_out": [],
    "failures": [],
}


def images_of(result, predicted):
    return view_images(result.scene, result.silhouettes, predicted)


def written(result, path, **changed):
    parts = {
        "title": "cup",
        "mesh": result.mesh,
        "asset": b"glTF and so on",
        "openness": openness(result.mesh),
        "seen": visible_vertices(result.mesh, result.cameras).any(dim=0),
        "scene": result.scene,
        "silhouettes": result.silhouettes,
        "reference": 1,
        "images": images_of(result, [None] * 3),
        "summary": SUMMARY,
        "settings": {"zeta": 0.5, "fuse": {"terms": ["normals", "points"], "max_hole": math.inf}},
    }
    write_page(path, **{**parts, **changed})
    return path.read_text(encoding="utf-8")


def element(page, name):
    return re.search(rf'<script [^>]*id="{name}">(.*?)</script>', page, re.DOTALL)[1]


def data_of(page):
    return json.loads(element(page, "data"))


def test_a_page_contains_its_data_and_fetches_no_other(reconstruction, tmp_path):
    layer = VertexLayer(attribute="_support", title="support", about="views", low=0, high=1,
                  low_text="none", high_text="full")  # fmt: skip
    page = written(reconstruction, tmp_path / "report.html", layers=[layer])
    data = data_of(page)
    assert base64.b64decode(element(page, "asset")) == b"glTF and so on"
    assert (data["title"], data["reference"]) == ("cup", 1)
    assert data["layers"][-1]["about"] == "views"
    assert len(base64.b64decode(data["openness"])) == len(reconstruction.mesh.vertices_world)
    assert data["settings"] == {
        "zeta": "0.5",
        "fuse": {"terms": '["normals", "points"]', "max_hole": "Infinity"},
    }
    assert [view["name"] for view in data["views"]] == list(reconstruction.scene.views.names)
    # The page fetches no file: all addresses are data, and its policy refuses others.
    template = page.replace(element(page, "data"), "")
    assert not re.search(r"<(?:script|link|img)[^>]+(?:src|href)=", template)
    assert "default-src 'none'" in page
    assert "somebody" not in page  # nor does it contain the user's name
    assert not re.search(r"\{(?:page|three)\.(?:css|js)\}|\{data\}|\{asset\}", page)


@pytest.mark.parametrize(
    "name", ["</script><script>alert(1)</script>", "<!--<script>", "a\u2028b\\n{data}", "{asset}"]
)
def test_file_names_are_escaped(reconstruction, tmp_path, name):
    plain = written(reconstruction, tmp_path / "plain.html")
    views = reconstruction.scene.views
    scene = reconstruction.scene.replace(views=views.replace(names=(name, *views.names[1:])))
    page = written(reconstruction, tmp_path / "hostile.html", scene=scene, title=name)
    assert data_of(page)["title"] == data_of(page)["views"][0]["name"] == name
    assert page.count("<script") == plain.count("<script")
    assert page.count("</script") == plain.count("</script") == 4


def test_pinholes_equal_those_of_the_run(reconstruction):
    scene = reconstruction.scene
    images = images_of(reconstruction, [None] * 3)
    entries = view_entries(scene, reconstruction.silhouettes, images)
    point = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    for view, entry in enumerate(entries):
        pose = torch.tensor(entry["pose"], dtype=torch.float64).reshape(4, 4)
        inside = pose[:3, :3] @ point + pose[:3, 3]
        pixel = inside[:2] / inside[2] * torch.tensor(entry["focal"]) + torch.tensor(
            entry["centre"]
        )
        own = scene.cameras.intrinsics[view].double() @ inside
        assert_close(pixel, own[:2] / own[2], rtol=1e-6, atol=1e-6)
        assert (entry["width"], entry["height"]) == tuple(scene.cameras.sizes_px[view].tolist())


def test_a_prediction_has_its_light(reconstruction):
    light = ViewLights(
        direction_world=torch.tensor([[0.0, 0.6, 0.8]]),
        inverse_distance=torch.tensor([0.25]),
        ambient=torch.tensor([[0.1]]),
        directed=torch.tensor([[0.5]]),
    )
    predicted = Prediction(radiance=torch.full((1, 40, 60), 0.2), light=light, psnr_db=30.0)
    lights_world = torch.tensor([[math.nan] * 4, [0.2, 0.1, 0.0, 0.3], [0.1, 0.0, 0.2, 0.0]])
    first, second, third = view_entries(
        reconstruction.scene,
        reconstruction.silhouettes,
        images_of(reconstruction, [None, predicted, predicted.replace(psnr_db=math.nan)]),
        lights_world,
    )
    assert not {"prediction", "psnr_db", "environment"} & set(first)
    assert "psnr_db" not in third
    assert second["environment"] == pytest.approx([0.2, 0.1, 0.0, 0.3])
    assert second["psnr_db"] == 30.0
    assert second["light"]["inverse_distance"] == 0.25
    assert second["light"]["directed"] == pytest.approx([0.5] * 3)
    assert second["light"]["direction"] == pytest.approx([0.0, 0.6, 0.8])
    picture = decoded(second["prediction"])
    assert abs(picture.mean() - 255 * float(srgb_from_linear(torch.tensor(0.2)))) < 1.5


def test_every_photograph_has_a_prediction(reconstruction):
    scene, mesh = reconstruction.scene, reconstruction.mesh
    lights = ViewLights(
        direction_world=torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3),
        inverse_distance=torch.zeros(3),
        ambient=torch.tensor([[0.1], [0.2], [0.4]]),
        directed=torch.zeros(3, 1),
    )
    materials = Materials.of(torch.zeros(len(mesh.vertices_world)).long(), torch.tensor([MATTE]))
    worth = ViewErrors(
        psnr_db=torch.tensor([30.04, torch.nan]), lights=lights, names=scene.views.names[:2]
    )
    relighting = Relighting(
        lights=lights, materials=materials, errors=worth, matte=worth, held_out=False
    )
    found = predictions(mesh, scene, relighting)
    assert found[0].psnr_db == pytest.approx(30.04)
    assert all(math.isnan(one.psnr_db) for one in found[1:])
    first, second, third = (one.radiance.sum() for one in found)
    assert first > 0
    assert second > 1.5 * first
    assert third > 1.5 * second
    assert found[0].radiance.shape[1:] == (40, 60)


def decoded(address):
    head, _, body = address.partition(",")
    assert head == "data:image/jpeg;base64"
    return np.asarray(Image.open(BytesIO(base64.b64decode(body))).convert("L")).astype(float)


def test_images_are_downscaled_by_averages_and_encoded_as_srgb():
    stripes = torch.tensor([0.0, 1.0]).repeat(100).expand(1, 100, 200)
    small = shrunk_to(stripes, 100)
    assert small.shape == (1, 50, 100)
    assert_close(small, torch.full_like(small, 0.5))
    assert shrunk_to(stripes, 400).shape == stripes.shape
    assert abs(decoded(jpeg(small)).mean() - 187.5) < 1.5


def test_more_photographs_have_smaller_images():
    assert longest_px(3) == longest_px(24) == 800
    area = [number * longest_px(number) ** 2 for number in (24, 66, 300)]
    assert max(area) < 1.01 * min(area)
    assert longest_px(10_000) == 120


def test_an_outline_is_the_border_of_the_silhouette():
    y, x = torch.meshgrid(torch.arange(60) + 0.5, torch.arange(80) + 0.5, indexing="ij")
    away = torch.hypot(x - 40, y - 30)
    path = outline((20.5 - away).clamp(0, 1), scale=10.0)
    assert path.count("M") == 1
    numbers = torch.tensor([float(one) for one in re.findall(r"-?\d+", path)]).reshape(-1, 2)
    radii = torch.hypot(numbers[:, 0] - 400, numbers[:, 1] - 300)
    assert_close(radii, torch.full_like(radii, 200.0), rtol=0.05, atol=0)
    assert len(numbers) < 2 * math.pi * 20


def left_out(guard, count, total=100, *, what="points", names=()):
    return {"guard": guard, "what": what, "count": count, "total": total, "reason": "dark",
            "names": list(names)}  # fmt: skip


def test_large_removals_are_listed_by_pass():
    entries = [
        left_out("sfm.missing", 1, what="photographs", names=["a.png"]),
        left_out("coarse.hull", 5),  # one twentieth: not listed
        left_out("warp", 99, what="pixels"),  # most facets face away from most views
        left_out("fuse.albedo", 6),
        left_out("repair", 0),
        left_out("fuse.albedo", 7),
        left_out("repair", 30),
        left_out("extract.borders", 50, what="faces"),
    ]
    found = [
        (one["heading"], [(entry["guard"], entry["count"]) for entry in one["entries"]])
        for one in left_out_by_pass(entries)
    ]
    assert found == [
        ("Cameras, silhouettes and coarse surface", [("sfm.missing", 1)]),
        ("Pass 1", [("fuse.albedo", 6)]),
        ("Pass 2", [("fuse.albedo", 7), ("repair", 30)]),
        ("Mesh", [("extract.borders", 50)]),
    ]
    assert left_out_by_pass([left_out("repair", 0), left_out("fuse.albedo", 5)]) == []


def test_lengths_are_in_the_known_unit_or_in_hundredths_of_the_diagonal():
    corners = torch.tensor([[0.0, 0, 0], [3.0, 4.0, 12.0]])
    box = Mesh(vertices_world=corners, faces=torch.zeros(0, 3, dtype=torch.long))
    assert length_unit(box).factor == pytest.approx(100 / 13)
    assert length_unit(box).name == "% of the object's size"
    assert (length_unit(box, "mm").factor, length_unit(box, "mm").name) == (1.0, "mm")
    layers = surface_layers(box.replace(expected_error=torch.tensor([0.26, 0.26])))
    assert [layer.high_text for layer in layers] == ["2 % of the object's size or more"]


@pytest.mark.parametrize(
    ("values", "high"),
    [
        (list(range(101)), 100.0),  # quartiles 25 and 75: the fence would be at 150
        ([*range(101), 1e6, 1e9], 77 + 1.5 * (77 - 25)),  # outliers are above the fence
        ([3.0] * 9, 3.0),
        ([math.nan, 2.0, math.inf], 2.0),
        ([math.nan], 0.0),
    ],
)
def test_outliers_do_not_stretch_the_colour_scale(values, high):
    layer = length_layer("_a", "a", "", torch.tensor(values), length_unit(SQUARE, "mm"))
    assert layer.low == 0
    assert layer.high == high
    assert layer.high_text.endswith("mm or more")


SQUARE = Mesh(vertices_world=CORNERS.float(), faces=FACETS)


def test_a_ball_has_no_ambient_occlusion():
    vertices, faces = icosphere(3)
    ball = Mesh(vertices_world=vertices, faces=faces, normals_world=vertices)
    assert_close(openness(ball), torch.ones(len(vertices)))


@pytest.mark.parametrize("depth", [0.5, 1.0, 2.0])
def test_the_floor_of_a_pit_is_lit_by_the_sky_above_its_rim(depth):
    """The centre of a round pit's floor receives r^2 / (r^2 + h^2) of the sky's irradiance."""
    angle = torch.arange(180) * (2 * torch.pi / 180)
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros(180)], dim=1)
    middle = torch.tensor([[0.0, 0.0, 0.0]])
    points = torch.cat([middle, ring, ring + torch.tensor([0.0, 0, depth])])
    here, there = torch.arange(180), (torch.arange(180) + 1) % 180
    floor = torch.stack([torch.zeros(180, dtype=torch.long), 1 + here, 1 + there], dim=1)
    wall = torch.stack([1 + here, 1 + there, 181 + there], dim=1)
    other = torch.stack([1 + here, 181 + there, 181 + here], dim=1)
    upward = torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3)
    pit = Mesh(vertices_world=points, faces=torch.cat([floor, wall, other]), normals_world=upward)
    # One ray is a fiftieth of the centre's irradiance.
    assert float(openness(pit)[0]) == pytest.approx(1 / (1 + depth**2), abs=0.04)


def one_camera(width=300):
    """A camera at distance 3 on the x axis; with 300 pixels, it has the unit ball in its image."""
    eye, up = torch.tensor([[3.0, 0.0, 0.0]]), torch.tensor([0.0, 0.0, 1.0])
    cameras = pinholes(look_at(eye, torch.zeros(3), up), 300.0, 300, 300)
    return cameras.replace(sizes_px=torch.tensor([[width, 300]]))


def test_a_camera_shows_a_ball_up_to_its_horizon():
    """The horizon of the unit ball from distance d is at 1 / d along the axis."""
    vertices, faces = icosphere(4)
    vertices = vertices.float()
    ball = Mesh(vertices_world=vertices, faces=faces, normals_world=vertices)
    shown, x, y, _ = visible_vertices(ball, one_camera())[0], *vertices.unbind(dim=1)
    clear = (x - 1 / 3).abs() > 0.05
    assert torch.equal(shown[clear], (x > 1 / 3)[clear])
    # The camera's right is +y; the left half of the image shows y < 0.
    half = visible_vertices(ball, one_camera(width=150))[0]
    clear &= y.abs() > 0.01
    assert torch.equal(half[clear], (shown & (y < 0))[clear])


def test_a_camera_does_not_show_what_is_occluded():
    """A shield between the camera and a ball."""
    vertices, faces = icosphere(3)
    corners = torch.tensor([[2.0, -1, -1], [2, 1, -1], [2, 1, 1], [2, -1, 1]])
    both = Mesh(
        vertices_world=torch.cat([vertices.float(), corners]),
        faces=torch.cat([faces, len(vertices) + torch.tensor([[0, 1, 2], [0, 2, 3]])]),
    )
    shown = visible_vertices(both, one_camera())[0]
    assert not shown[: len(vertices)].any()
