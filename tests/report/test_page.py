import base64
import json
import math
import re
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.records import Judged, Materials, Relighting, ViewLights
from pimper_torch.result.report.page import section_entries, write_page
from pimper_torch.result.report.predictions import (
    Prediction,
    jpeg,
    longest_px,
    outline,
    predictions,
    shrunk,
    view_entries,
)
from pimper_torch.result.report.vertex_layers import VertexLayer

MATTE = (0.0, 1.0, 0.0)  # metallic, roughness, specular
SUMMARY = {
    "doubt": None,
    "warnings": ["two photographs are blurred; take them again"],
    "seconds": 12.0,
    "peak_memory_mb": 900.0,
    "peak_memory_stage": "fuse",
    "stages": [
        {"name": "warp", "seconds": 4.0, "peak_memory_mb": 500.0, "kept": False, "samples": 12345},
        {"name": "fuse", "seconds": 8.0, "peak_memory_mb": 900.0, "kept": False},
        {"name": "sweep", "seconds": 90.0, "peak_memory_mb": 800.0, "kept": True},
    ],
    "left_out": [
        {"guard": "warp", "what": "pixels", "count": 2000, "total": 9000, "reason": "dark",
         "names": ["a.png"]},
        {"guard": "repair", "what": "points", "count": 0, "total": 10, "reason": "folds",
         "names": []},
    ],
    "failures": [],
}  # fmt: skip


def written(result, path, **changed):
    parts = {
        "title": "cup",
        "headline": "3 of 3 photographs",
        "asset": b"glTF and so on",
        "scene": result.scene,
        "silhouettes": result.silhouettes,
        "reference": 1,
        "predictions": [None] * result.scene.views.num_views,
        "layers": [],
        "summary": SUMMARY,
        "settings": "zeta: 0.5\n",
    }
    write_page(path, **{**parts, **changed})
    return path.read_text(encoding="utf-8")


def element(page, name):
    return re.search(rf'<script [^>]*id="{name}">(.*?)</script>', page, re.DOTALL)[1]


def data_of(page):
    return json.loads(element(page, "data"))


def test_a_page_holds_what_it_is_told_and_needs_nothing_else(reconstruction, tmp_path):
    layer = VertexLayer(attribute="_support", title="support", about="views", low=0, high=1,
                  low_text="none", high_text="full")  # fmt: skip
    page = written(reconstruction, tmp_path / "report.html", layers=[layer])
    data = data_of(page)
    assert base64.b64decode(element(page, "asset")) == b"glTF and so on"
    assert (data["title"], data["headline"], data["reference"]) == ("cup", "3 of 3 photographs", 1)
    assert data["layers"][0]["attribute"] == "_support"
    assert [view["name"] for view in data["views"]] == list(reconstruction.scene.views.names)
    # Nothing is fetched: no address but data, and the browser is told to refuse others.
    template = page.replace(element(page, "data"), "")
    assert not re.search(r"<(?:script|link|img)[^>]+(?:src|href)=", template)
    assert "default-src 'none'" in page
    assert not re.search(r"\{(?:page|three)\.(?:css|js)\}|\{data\}|\{asset\}", page)


@pytest.mark.parametrize(
    "name", ["</script><script>alert(1)</script>", "<!--<script>", "a\u2028b\\n{data}", "{asset}"]
)
def test_names_of_files_cannot_leave_their_text(reconstruction, tmp_path, name):
    plain = written(reconstruction, tmp_path / "plain.html")
    views = reconstruction.scene.views
    scene = reconstruction.scene.replace(views=views.replace(names=(name, *views.names[1:])))
    page = written(reconstruction, tmp_path / "hostile.html", scene=scene, title=name)
    assert data_of(page)["title"] == data_of(page)["views"][0]["name"] == name
    assert page.count("<script") == plain.count("<script")
    assert page.count("</script") == plain.count("</script") == 4


def test_pinholes_are_those_of_the_run(reconstruction):
    scene = reconstruction.scene
    entries = view_entries(scene, reconstruction.silhouettes, [None] * 3)
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


def test_a_prediction_comes_with_its_light(reconstruction):
    light = ViewLights(
        direction_world=torch.tensor([[0.0, 0.6, 0.8]]),
        closeness=torch.tensor([0.25]),
        ambient=torch.tensor([[0.1]]),
        directed=torch.tensor([[0.5]]),
    )
    told = Prediction(radiance=torch.full((1, 40, 60), 0.2), light=light, figure="30.0 dB")
    first, second, _ = view_entries(
        reconstruction.scene, reconstruction.silhouettes, [None, told, None]
    )
    assert "prediction" not in first
    assert second["figure"] == "30.0 dB"
    assert second["light"]["closeness"] == 0.25
    assert second["light"]["directed"] == pytest.approx([0.5] * 3)
    assert second["light"]["direction"] == pytest.approx([0.0, 0.6, 0.8])
    picture = decoded(second["prediction"])
    assert abs(picture.mean() - 255 * float(srgb_from_linear(torch.tensor(0.2)))) < 1.5


def test_predictions_are_of_every_photograph(reconstruction):
    scene, mesh = reconstruction.scene, reconstruction.mesh
    lights = ViewLights(
        direction_world=torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3),
        closeness=torch.zeros(3),
        ambient=torch.tensor([[0.1], [0.2], [0.4]]),
        directed=torch.zeros(3, 1),
    )
    materials = Materials.of(torch.zeros(len(mesh.vertices_world)).long(), torch.tensor([MATTE]))
    worth = Judged(
        psnr_db=torch.tensor([30.04, torch.nan]), lights=lights, names=scene.views.names[:2]
    )
    relighting = Relighting(
        lights=lights, materials=materials, judged=worth, matte=worth, held_out=False
    )
    found = predictions(mesh, scene, relighting)
    assert [one.figure for one in found] == ["30.0 dB", "", ""]
    first, second, third = (one.radiance.sum() for one in found)
    assert first > 0
    assert second > 1.5 * first
    assert third > 1.5 * second
    assert found[0].radiance.shape[1:] == (40, 60)


def decoded(address):
    head, _, body = address.partition(",")
    assert head == "data:image/jpeg;base64"
    return np.asarray(Image.open(BytesIO(base64.b64decode(body))).convert("L")).astype(float)


def test_pictures_shrink_by_averages_and_are_encoded_for_the_screen():
    stripes = torch.tensor([0.0, 1.0]).repeat(100).expand(1, 100, 200)
    small = shrunk(stripes, 100)
    assert small.shape == (1, 50, 100)
    assert_close(small, torch.full_like(small, 0.5))
    assert shrunk(stripes, 400).shape == stripes.shape
    assert abs(decoded(jpeg(small)).mean() - 187.5) < 1.5


def test_more_photographs_share_the_room():
    assert longest_px(3) == longest_px(24) == 800
    area = [number * longest_px(number) ** 2 for number in (24, 66, 300)]
    assert max(area) < 1.01 * min(area)
    assert longest_px(10_000) == 120


def test_an_outline_is_where_the_silhouette_ends():
    y, x = torch.meshgrid(torch.arange(60) + 0.5, torch.arange(80) + 0.5, indexing="ij")
    away = torch.hypot(x - 40, y - 30)
    path = outline((20.5 - away).clamp(0, 1), scale=10.0)
    assert path.count("M") == 1
    numbers = torch.tensor([float(one) for one in re.findall(r"-?\d+", path)]).reshape(-1, 2)
    radii = torch.hypot(numbers[:, 0] - 400, numbers[:, 1] - 300)
    assert_close(radii, torch.full_like(radii, 200.0), rtol=0.05, atol=0)
    assert len(numbers) < 2 * math.pi * 20


def sections_of(**changed):
    entries = section_entries({**SUMMARY, **changed}, "zeta: 0.5\n")
    return {one["title"]: one for one in entries}


def test_sections_tell_stages_guards_and_warnings():
    sections = sections_of()
    assert sections["Warnings"]["items"] == SUMMARY["warnings"]
    rows = sections["Stages"]["table"]["rows"]
    assert [row[1] for row in rows] == ["4.0", "8.0", "kept"]
    assert [row[2] for row in rows] == [0.5, 1.0, 0]  # a kept stage took its time elsewhere
    assert rows[0][4] == "samples 12,345"
    guards = sections["Left out, and by whom"]
    assert guards["table"]["rows"] == [["warp", "2,000", "9,000", "pixels", "dark: a.png"]]
    assert "repair" in guards["text"]
    assert sections["Settings"]["code"] == "zeta: 0.5\n"
    assert not {"Failed", "Photographs predicted from the surface"} & set(sections)
    failure = {"stage": "fuse", "what": "patch", "names": ["3", "5"], "reason": "no light",
               "done": "left out"}  # fmt: skip
    sections = sections_of(doubt="cameras doubtful", failures=[failure])
    assert sections["Warnings"]["items"][0] == "cameras doubtful"
    assert sections["Failed"]["table"]["rows"] == [["fuse", "patch 3, 5", "no light", "left out"]]
    assert sections_of(warnings=[])["Warnings"] == {"title": "Warnings", "text": "None."}


def test_what_predictions_are_worth_is_told_with_the_materials():
    views = [{"name": "a.png", "psnr_db": 31.0, "psnr_matte_db": None}]
    material = {"vertices": 1.0, "metallic": 0.0, "roughness": 0.35, "specular": 1.2}
    told = {"photographs": "held out", "psnr_db": 31.0, "psnr_matte_db": 29.0, "views": views,
            "materials": [material]}  # fmt: skip
    found = sections_of(relighting=told)["Photographs predicted from the surface"]
    assert "held out" in found["text"]
    assert "roughness 0.35" in found["text"]
    assert [row[:3] for row in found["table"]["rows"]] == [
        ["mean", "31.00", "29.00"],
        ["a.png", "31.00", ""],
    ]
    used = sections_of(relighting={**told, "photographs": "used"})
    assert "made from" in used["Photographs predicted from the surface"]["text"]
    unknown = sections_of(relighting={**told, "psnr_db": None})
    assert "Photographs predicted from the surface" not in unknown
