import pytest
import torch
from scenes import observing
from torch.nn.functional import interpolate

from pimper_torch.geometry.visual_hull import margins, visual_hull
from pimper_torch.records import SilhouettePrior
from pimper_torch.runtime.errors import InputError, PimperWarning
from pimper_torch.stages.silhouettes.cues import keep_seeded_components, soft_masks_of
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from tests.silhouettes.conftest import SMALL, overlap
from tests.silhouettes.shapes import HEIGHT, WIDTH, all_round, silhouettes_of


def guessed(names, inside):
    height, width = inside.shape[-2:]
    sizes = torch.tensor([[width, height]] * len(names))
    return SilhouettePrior(names=names, sizes_px=sizes, inside=inside, undistorted=True)


def with_priors(scene, *priors):
    return scene.replace(views=scene.views.replace(priors=priors))


def soft(truth, size=(180, 240)):
    """Return masks like those of a segmenter: 8 bits, soft at their borders."""
    small = interpolate(truth[None].float(), size, mode="area")[0]
    return (255 * (0.02 + 0.96 * small)).round() / 255


def without_any_hint(scene):
    """Return a scene with one colour and no points: only masks indicate the object."""
    images = torch.full_like(scene.views.images, 0.3)
    return observing(scene, slice(0)).replace(views=scene.views.replace(images=images))


def test_masks_at_half_size_are_followed(staged):
    scene = without_any_hint(staged.scene)
    prior = guessed(scene.views.names, soft(staged.truth, (90, 120)))
    found = FindSilhouettes(SMALL)(with_priors(scene, prior))
    assert found.source == "found"
    assert found.reliable.all()
    # Without colours the cut is anywhere within 1.5 pixels of the mask border: 0.89 of 50.
    assert overlap(found.masks, staged.truth).min() > 0.9


def test_excess_in_a_few_masks_is_outvoted(staged):
    scene, wide = without_any_hint(staged.scene), staged.truth.clone()
    for view in (1, 4, 8):
        wide[view, 60:170, 20 + 5 * view : 60 + 5 * view] = True
    assert overlap(wide, staged.truth)[[1, 4, 8]].max() < 0.8
    found = FindSilhouettes(SMALL)(with_priors(scene, guessed(scene.views.names, soft(wide))))
    assert overlap(found.masks, staged.truth).min() > 0.9


def test_masks_of_a_different_object_warn_with_their_names(staged):
    wrong, views = staged.truth.clone(), [0, 6, 7]
    for view in views:
        wrong[view] = False
        wrong[view, 120:170, 20:70] = True
    prior = guessed(staged.scene.views.names, soft(wrong))
    names = ", ".join(staged.scene.views.names[view] for view in views)
    with pytest.warns(PimperWarning, match=rf"\(views? {names}\): its soft mask lacks"):
        found = FindSilhouettes(SMALL)(with_priors(staged.scene, prior))
    assert overlap(found.masks, staged.truth).min() > 0.95


def test_masks_of_some_photographs_suffice(staged):
    names = staged.scene.views.names
    prior = guessed((*names[::3], "another.png"), soft(staged.truth)[[0, 3, 6, 9, 0]])
    found = FindSilhouettes(SMALL)(with_priors(staged.scene, prior))
    assert overlap(found.masks, staged.truth).min() > 0.95


def test_log_odds_of_two_maps_of_a_view_add_up(staged):
    views, (first, second) = staged.scene.views, (0.8 * torch.ones(1, 9, 12), 0.3)
    first[0, 0, 0], second = 0.1, torch.full((1, 9, 12), second)
    views = views.replace(priors=(guessed(("04.png",), first), guessed(("04.png",), second)))
    merged = soft_masks_of(views, staged.scene.cameras.sizes_px)
    assert merged is not None
    assert merged.given.nonzero().tolist() == [[4]]
    odds = 0.8 / 0.2 * 0.3 / 0.7
    assert merged.inside[4, 100, 100] == pytest.approx(odds / (1 + odds), abs=1e-4)
    assert (merged.inside[[3, 5]] == 0.5).all()


def test_a_map_without_background_seeds_the_object(staged):
    pointing = torch.full((1, 180, 240), 0.5)
    pointing[0, 80:83, 100:103] = 1
    views = staged.scene.views.replace(priors=(guessed(("02.png",), pointing),))
    merged = soft_masks_of(views, staged.scene.cameras.sizes_px)
    assert merged is not None
    assert not merged.given.any()
    assert merged.seeds_px[2].mean(dim=0).tolist() == pytest.approx([101.5, 81.5])
    assert sum(len(pixels) for pixels in merged.seeds_px) == 9


@pytest.mark.parametrize("place", [(100, 5), (5, 100)])
def test_a_click_off_the_object_is_rejected_by_name(staged, place):
    """A click on the table is rejected even if a second one in the photograph is on the ball."""
    row, column = staged.truth[4].nonzero().float().mean(dim=0).long().tolist()
    pointing = torch.full((1, 180, 240), 0.5)
    pointing[0, row : row + 3, column : column + 3] = 1
    prior = guessed(staged.scene.views.names, soft(staged.truth))
    met = guessed(("04.png",), pointing)
    found = FindSilhouettes(SMALL)(with_priors(staged.scene, prior, met))
    assert overlap(found.masks, staged.truth).min() > 0.95
    pointing = pointing.clone()
    pointing[0, place[0] : place[0] + 3, place[1] : place[1] + 3] = 1
    missed = guessed(("04.png",), pointing)
    with pytest.raises(InputError, match=r"A click in 04\.png is outside"):
        FindSilhouettes(SMALL)(with_priors(staged.scene, prior, missed))


def test_the_first_component_along_the_ray_of_a_click_is_kept():
    cameras = all_round().to(torch.float32)
    places = torch.tensor([[-0.35, 0.0, 0.0], [0.35, 0.0, 0.0]])

    def ball(index):
        return lambda points: (points - places[index].to(points)).norm(dim=-1) - 0.2

    def both(points):
        return torch.minimum(ball(0)(points), ball(1)(points))

    box = torch.tensor([[-0.8] * 3, [0.8] * 3])
    hull = visual_hull(silhouettes_of(both, cameras), cameras, box, num_voxels=500_000)
    assert hull is not None
    alone = silhouettes_of(ball(1), cameras).masks
    view = int((silhouettes_of(ball(0), cameras).masks & alone).sum(dim=(1, 2)).argmin())
    seeds = [torch.zeros(0, 2)] * cameras.num_views
    seeds[view] = torch.tensor([[0.5, 0.5]])
    assert keep_seeded_components(hull, cameras, seeds) is hull  # the ray has no hit
    seeds[view] = alone[view].nonzero().float().mean(dim=0).flip(0)[None] + 0.5
    kept = keep_seeded_components(hull, cameras, seeds)
    assert kept.holds(places).tolist() == [False, True]
    inside = kept.occupied
    assert torch.equal(kept.distance[inside], hull.distance[inside])
    own = visual_hull(silhouettes_of(ball(1), cameras), cameras, box, num_voxels=500_000)
    assert own is not None
    lens = cameras.intrinsics[view], cameras.cam_from_world[view], (WIDTH, HEIGHT)
    shown, alone_shown = (margins(one, *lens) > 0 for one in (kept, own))
    assert overlap(shown[None], alone_shown[None]).item() > 0.95  # voxel sizes differ
