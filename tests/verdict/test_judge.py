"""The verdict is that of the least favourable figure, and names it with a photograph."""

import re
from itertools import pairwise

import pytest
import torch
from scenes import trusted

from pimper_torch.geometry.coverage import coverage_by
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Materials, Relighting, Silhouettes, ViewErrors, ViewLights
from pimper_torch.stages.verdict.judge import LIMITS, Judge, in_unit, score_of

judge = Judge()


@pytest.mark.parametrize("name", LIMITS)
def test_scores_follow_the_limits_and_end_there(name):
    unusable, good, best = LIMITS[name]
    assert [score_of(name, value) for value in LIMITS[name]] == [0, 0.5, 1]
    assert score_of(name, 2 * unusable - good) == 0
    assert score_of(name, 2 * best - good) == 1
    between = [score_of(name, unusable + part * (best - unusable)) for part in (0.2, 0.5, 0.8)]
    assert all(low < high for low, high in pairwise(between))


@pytest.fixture
def result(reconstruction):
    """A result whose silhouettes are those of its surface, and which predicts its photographs."""
    mesh, cameras = reconstruction.mesh, reconstruction.cameras
    caster = RayCaster(mesh.vertices_world, mesh.faces)
    inside = []
    for view, (width, height) in enumerate(cameras.sizes_px.tolist()):
        indices = torch.cartesian_prod(torch.arange(width), torch.arange(height))
        pixels = pixels_from_indices(indices.float())
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        hit = caster.cast(cameras.centers_world[view], rays).face >= 0
        inside.append(hit.reshape(width, height).mT.float())
    scene = reconstruction.scene.replace(unregistered=())
    silhouettes = trusted(torch.stack(inside), "found")
    return predicting(reconstruction.replace(scene=scene, silhouettes=silhouettes), 35.0)


def predicting(result, *psnr_db):
    """Return the result with errors of its predictions; one for all views, or one for each."""
    names = result.scene.views.names
    zeros = torch.zeros(len(names), 3)
    lights = ViewLights(
        direction_world=zeros + torch.tensor([0.0, 0, 1]),
        inverse_distance=zeros[:, 0],
        ambient=zeros,
        directed=zeros + 1,
    )
    errors = ViewErrors(
        psnr_db=torch.tensor(psnr_db).expand(len(names)).clone(), lights=lights, names=names
    )
    materials = Materials.of(
        torch.zeros(len(result.mesh.vertices_world), dtype=torch.long), torch.zeros(1, 3)
    )
    lit = Relighting(
        lights=lights, materials=materials, errors=errors, matte=errors, held_out=False
    )
    return result.replace(relighting=lit)


def expecting(result, error):
    """Return the result with an expected error, scene units; its extent is 2.87."""
    mesh = result.mesh
    errors = torch.full_like(mesh.vertices_world[:, 0], error)
    return result.replace(mesh=mesh.replace(expected_error=errors))


def test_a_result_that_agrees_with_its_photographs_is_good(result):
    found = judge(result)
    assert found.good
    assert found.text == "Good: from 3 of 3 photographs; the back was not photographed."
    assert judge(expecting(result, 0.0288)).text == (
        "Good: from 3 of 3 photographs, with an expected error of 1.00% of the extent; the back "
        "was not photographed."
    )
    assert found.score == min(found.scores.values()) >= 0.5
    assert {"covered", "sticking_out"} <= found.scores.keys() <= LIMITS.keys()


@pytest.mark.parametrize(
    ("error", "said"), [(0.196, "0.2 mm"), (2.345, "2.3 mm"), (1234.0, "1200 mm")]
)
def test_the_expected_error_is_in_the_unit_of_a_scaled_result(result, error, said):
    mesh = expecting(result, error).mesh
    text = judge(expecting(result, 0.0288)).text
    assert in_unit(text, mesh, "mm") == text.replace(
        "1.00% of the extent", f"{said} (1.00% of the extent)"
    )
    assert in_unit("Look at a.png.", mesh, "mm") == "Look at a.png."
    assert in_unit(text, mesh.replace(expected_error=None), "mm") == text


def test_unreliable_cameras_are_not_usable(result):
    scene = result.scene.replace(diagnosis="The cameras are unreliable: why.")
    found = judge(result.replace(scene=scene))
    assert (found.score, found.good) == (0, False)
    assert found.text == "Not usable: The cameras are unreliable: why."


def without_one_side(result):
    mesh = result.mesh
    left = mesh.vertices_world[mesh.faces].mean(dim=1)[:, 0] < -0.7
    return result.replace(mesh=mesh.replace(faces=mesh.faces[~left]))


def wider(result):
    mesh = result.mesh
    return result.replace(mesh=mesh.replace(vertices_world=1.06 * mesh.vertices_world))


def with_overlaps(result, *overlaps):
    found = result.silhouettes.replace(expected_overlap=torch.tensor(overlaps))
    return result.replace(silhouettes=found)


def with_reliable(result, *reliable):
    found = result.silhouettes.replace(reliable=torch.tensor(reliable))
    return result.replace(silhouettes=found)


BAD = {
    "covered": (
        without_one_side,
        r"a\.png: the surface lacks 1\d% of the silhouette, and 1\d% in the mean\. Phot",
    ),
    "sticking_out": (
        wider,
        r"b\.png: the surface sticks out of the silhouette by 1\d% of its area, and by 1\d% in the",
    ),
    "predicted_db": (
        lambda result: predicting(result, 20.0, 14.0, 17.0),
        r"b\.png: the surface predicts the photographs only with a PSNR of 17 dB\. ",
    ),
    "expected_overlap": (
        lambda result: with_overlaps(result, 0.8, 0.8, 0.7),
        r"c\.png: the silhouettes are expected to overlap the object by only 77%\. Check masks/",
    ),
    "reliable": (
        lambda result: with_reliable(result, True, False, False),
        r"b\.png: 2 of 3 silhouettes contradict the others\. ",
    ),
    "registered": (
        lambda result: result.replace(scene=result.scene.replace(unregistered=("d.png", "e.png"))),
        r"d\.png: 2 of 5 photographs were not registered\. Photograph the object",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_the_least_favourable_figure_is_named_with_a_photograph(result, name):
    change, text = BAD[name]
    found = judge(change(result))
    assert min(found.scores, key=found.scores.get) == name
    assert 0 < found.score < 0.5
    assert not found.good
    assert re.match(f"Look at {text}", found.text), found.text


def test_photographs_without_given_cameras_do_not_count_against_the_result(result):
    missing = result.scene.replace(unregistered=tuple(f"{index}.png" for index in range(9)))
    assert judge(result.replace(scene=missing)).scores["registered"] < 0.5
    assert "registered" not in judge(result.replace(scene=missing.replace(given=True))).scores


def test_the_sentence_has_the_figures_of_the_view_and_of_the_mean(result):
    inside = result.silhouettes.inside.clone()
    inside[1, :4] = 1  # a strip above the surface
    result = result.replace(silhouettes=result.silhouettes.replace(inside=inside))
    lacking = coverage_by(result.mesh, result.silhouettes, result.cameras).uncovered
    assert lacking.max() > 2 * lacking.mean()
    text = (
        f"b.png: the surface lacks {lacking.max():.0%} of the silhouette, and {lacking.mean():.0%}"
    )
    assert text in judge(result).text


def test_an_unusable_figure_has_no_photograph(result):
    assert judge(with_overlaps(result, 0.5, 0.5, 0.5)).text.startswith("Not usable: the silh")


def test_figures_that_are_unknown_have_no_score(result):
    everything = Silhouettes.everything(result.scene.views)
    found = judge(result.replace(relighting=None, silhouettes=everything))
    assert found.scores.keys() == {"determined"}
    blank = judge(predicting(with_reliable(result, False, False, False), torch.nan))
    assert blank.scores.keys() == {"determined"}
