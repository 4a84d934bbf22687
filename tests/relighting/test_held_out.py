import math

import pytest
import torch

from pimper_torch.chains.prepare import split_held_out
from pimper_torch.export.reports import relighting_report
from pimper_torch.geometry.poisson import reduced
from pimper_torch.records import Silhouettes
from pimper_torch.runtime.errors import ConfigError
from pimper_torch.stages.relighting.held_out import JudgeTextures, Relight
from pimper_torch.stages.texturing.bake import textured
from tests.relighting.ball import ball_mesh, photographed

GLOSSY = (0.0, 0.3, 1.0)


@pytest.fixture(scope="module")
def scene():
    return photographed(GLOSSY, views=6)[0]


def test_every_nth_photograph_is_held_out_unless_it_is_needed(scene):
    used, held = split_held_out(scene, 3)
    assert held.views.names == ("002", "005")
    assert used.views.names == ("000", "001", "003", "004")
    assert used.unregistered == held.unregistered == ()
    assert torch.equal(held.cameras.cam_from_world, scene.cameras.cam_from_world[[2, 5]])
    assert torch.equal(used.points_world, scene.points_world)
    turned = scene.replace(views=scene.views.replace(names=("5", "4", "3", "2", "1", "0")))
    assert split_held_out(turned, 3)[1].views.names == ("5", "2")
    assert split_held_out(scene, 3, ["005"])[1].views.names == ("002",)
    assert split_held_out(scene, 6, ["005"])[0] is scene
    assert split_held_out(scene, 0) == (scene, None)


def test_too_few_photographs_are_refused(scene):
    four = photographed(GLOSSY, views=4)[0]
    with pytest.raises(ConfigError, match="hold_out is 2; needed: a number that leaves at least 3"):
        split_held_out(four, 2)


def test_held_out_photographs_are_predicted_better_with_their_highlights(scene):
    used, held = split_held_out(scene, 3)
    found = Relight()(ball_mesh(), used, Silhouettes.everything(used.views), held)
    report = relighting_report(found)
    assert report["photographs"] == "held out"
    assert [view["name"] for view in report["views"]] == ["002", "005"]
    assert all(view["psnr_db"] > view["psnr_matte_db"] + 1 for view in report["views"])
    assert report["psnr_db"] > 40
    (material,) = report["materials"]
    assert material["vertices"] == 1
    assert abs(material["roughness"] - GLOSSY[1]) < 0.1


def test_without_held_out_photographs_the_used_ones_are_predicted():
    scene = photographed((0.0, 1.0, 0.0), views=3)[0]
    found = Relight()(ball_mesh(), scene, Silhouettes.everything(scene.views))
    report = relighting_report(found)
    assert report["photographs"] == "used"
    assert report["psnr_db"] == report["psnr_matte_db"]
    assert len(report["views"]) == 3


def test_unobserved_surface_has_no_figure():
    scene = photographed((0.0, 1.0, 0.0), views=3)[0]
    empty = Silhouettes.everything(scene.views).replace(
        inside=torch.zeros_like(scene.views.images[:, 0])
    )
    report = relighting_report(Relight()(ball_mesh(), scene, empty))
    assert report["psnr_db"] is None
    assert not math.isnan(report["materials"][0]["roughness"])


def test_textures_predict_photographs_better_than_vertices_of_few_faces(scene):
    full = ball_mesh()
    few = reduced(full, 1200)
    found = Relight()(few, scene, None)
    asset = textured(full, few, found.materials.at_vertices())
    errors = JudgeTextures()(found, asset, scene, None)
    coarse, fine = found.errors.psnr_db.mean(), errors.textured.psnr_db.mean()
    assert fine > coarse + 1
    assert fine > 45  # eight bits per texel
    assert relighting_report(errors)["psnr_textured_db"] == pytest.approx(float(fine), abs=1e-3)
    assert relighting_report(found)["psnr_textured_db"] is None
