"""Silhouettes that are cut again by the surface: on a ball whose cuts are spoiled."""

import pytest
import torch
import trimesh

from pimper_torch.records import Mesh, Silhouettes
from pimper_torch.silhouettes.correct import CorrectSilhouettes, projections
from pimper_torch.silhouettes.settings import SilhouetteConfig, SilhouetteDetails
from tests.silhouettes.conftest import CENTER, RADIUS

SMALL = SilhouetteConfig(size_px=240), SilhouetteDetails(num_voxels=60_000)


@pytest.fixture(scope="module")
def ball() -> Mesh:
    sphere = trimesh.creation.icosphere(4, float(RADIUS))
    return Mesh(
        vertices_world=torch.tensor(sphere.vertices, dtype=torch.float32) + CENTER,
        faces=torch.tensor(sphere.faces),
    )


def overlap(found, truth):
    return (found & truth).sum(dim=(1, 2)) / (found | truth).sum(dim=(1, 2))


def found(masks: torch.Tensor) -> Silhouettes:
    reliable = torch.ones(len(masks), dtype=torch.bool)
    return Silhouettes(inside=masks.float(), reliable=reliable, source="found")


def test_a_mesh_is_projected_to_a_ray_or_two(staged, ball):
    seen = projections(ball, staged.scene.cameras, (240, 180))
    assert overlap(seen, staged.truth).min() > 0.96  # one pixel round a ball of 50


def test_a_cut_that_lost_a_part_or_took_the_table_in_is_corrected(staged, ball):
    masks = staged.truth.clone()
    masks[2, :, :120] = False  # half of the ball
    masks[7] |= masks[7].roll(12, 1)  # as much table as a shadow
    before = overlap(masks, staged.truth)
    corrected = CorrectSilhouettes(*SMALL)(staged.scene, found(masks), ball)
    after = overlap(corrected.masks, staged.truth)
    assert before[2] < 0.7
    assert before[7] < 0.9
    assert after.min() > 0.95
    assert corrected.source == "found"
    assert corrected.reliable.all()


def test_what_the_surface_lacks_stays_where_cut_and_photograph_have_it(staged, ball):
    """A surface that ends short of its rim takes nothing away from good cuts."""
    vertices = CENTER + 0.94 * (ball.vertices_world - CENTER)
    corrected = CorrectSilhouettes(*SMALL)(
        staged.scene, found(staged.truth), ball.replace(vertices_world=vertices)
    )
    assert overlap(corrected.masks, staged.truth).min() > 0.95


def test_a_cut_that_the_surface_does_not_confirm_is_not_taken(staged, ball):
    """A surface elsewhere leads to cuts that have little to do with it."""
    small = CENTER + 0.3 * (ball.vertices_world - CENTER)
    silhouettes = found(staged.truth)
    corrected = CorrectSilhouettes(*SMALL)(
        staged.scene, silhouettes, ball.replace(vertices_world=small)
    )
    assert torch.equal(corrected.inside, silhouettes.inside)


@pytest.mark.parametrize("source", ["masks", "everything"])
def test_masks_that_are_given_and_everything_stay_as_they_are(staged, ball, source):
    silhouettes = found(staged.truth).replace(source=source)
    assert CorrectSilhouettes(*SMALL)(staged.scene, silhouettes, ball) is silhouettes
