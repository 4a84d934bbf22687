import pytest
import torch
from scenes import observing, trusted
from sparse_models import views_of
from torch import nn

from pimper_torch.geometry.opencv import signed_distance
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.supporting_plane import Plane, fixation
from pimper_torch.records import Silhouettes
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning
from pimper_torch.stages.silhouettes import cuts, find
from pimper_torch.stages.silhouettes.cues import (
    Cues,
    cues_of,
)
from pimper_torch.stages.silhouettes.cuts import cuts_of
from pimper_torch.stages.silhouettes.find import FindSilhouettes, by_session, masked
from pimper_torch.stages.silhouettes.parallax import (
    background_agreement,
    plane_agreement,
    static_background_maps,
    working_pictures,
)
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig
from tests.silhouettes import shapes
from tests.silhouettes.conftest import SMALL, overlap


def test_a_ball_on_a_table_is_found_in_every_view(staged):
    silhouettes = FindSilhouettes(SMALL)(staged.scene)
    assert silhouettes is not None
    assert silhouettes.source == "found"
    assert silhouettes.reliable.all()
    # One pixel around the ball of 50 pixels gives 0.96; the table or its shadow far less.
    assert overlap(silhouettes.masks, staged.truth).min() > 0.95
    used = masked(staged.scene, silhouettes).views.masks  # a little wider
    assert (used | ~silhouettes.masks).all()
    assert used.sum() > silhouettes.masks.sum()
    assert masked(staged.scene, Silhouettes.everything(staged.scene.views)) is staged.scene


def without_points_of_the_ball(scene):
    on_ball = scene.points_world[:, 2] > 0.01
    return observing(scene, ~on_ball[scene.observation_point])


def test_an_object_without_a_point_is_found_by_parallax(staged):
    silhouettes = FindSilhouettes(SMALL)(without_points_of_the_ball(staged.scene))
    assert silhouettes is not None
    assert overlap(silhouettes.masks, staged.truth).median() > 0.9


def test_an_object_in_front_of_a_dark_background_is_found(staged):
    """The table ends below the middle of the ball; the background is black."""
    images = staged.scene.views.images.clone()
    images[:, :, :70] *= staged.truth[:, None, :70]
    scene = staged.scene.replace(views=staged.scene.views.replace(images=images))
    silhouettes = FindSilhouettes(SMALL)(without_points_of_the_ball(scene))
    assert overlap(silhouettes.masks, staged.truth).median() > 0.9


def test_occluders_are_inside_silhouettes_but_not_used(staged):
    hidden = torch.zeros_like(staged.truth)
    hidden[3, 80:100, 110:130] = True
    silhouettes = trusted(staged.truth.float(), "found", hidden=hidden & staged.truth)
    used = masked(staged.scene, silhouettes).views.masks
    assert torch.equal(silhouettes.masks, staged.truth)
    assert torch.equal(silhouettes.shown, staged.truth & ~hidden)
    assert torch.equal(used, silhouettes.shown)
    assert (staged.truth & ~used).sum() > 100


@pytest.mark.parametrize("seen_in", [1, 3])
def test_a_view_abstains_at_occluders_of_the_object(staged, monkeypatch, seen_in):
    """Plane pixels outside a cut carve the hull; occluder pixels do not."""
    cues = cues_of(staged.scene, SMALL)
    agreement = torch.where(staged.truth, -0.2, 0.95)
    person = torch.zeros_like(staged.truth)
    for view in range(0, 12, 4)[:seen_in]:
        column = int(staged.truth[view].any(dim=0).nonzero().double().mean())
        person[view, :, column : column + 60] = True
    cut = staged.truth & ~person
    monkeypatch.setattr(cuts, "_initial_cuts", lambda cues: cut)
    monkeypatch.setattr(cuts, "_cut_again", lambda cues, masks, seen, unknown: cut)
    monkeypatch.setattr(Cues, "relearned", lambda cues, masks: cues)
    known = cues.replace(agreement=agreement.where(~person, -0.2))
    carved = cues.replace(agreement=agreement.where(~person, 0.95))
    found, plain = (cuts.cut_in_iterations(one) for one in (known, carved))
    assert overlap(found.masks, staged.truth).min() > 0.93
    assert torch.equal(found.masks & ~found.hidden, cut)
    assert (found.hidden & ~person).sum() == 0
    assert plain.hidden is None
    assert overlap(plain.margins_px > 0, staged.truth).min() < 0.8


def with_masks(scene, masks):
    return scene.replace(views=scene.views.replace(masks=masks))


def test_given_masks_are_trusted(staged):
    drawn = staged.truth.clone()
    # Only part of the ball.
    drawn[:, :90] &= pixel_centers(240, 180, like=torch.ones(()))[:90, :, 0] < 120
    for masks in (staged.truth, drawn):
        scene = with_masks(staged.scene, masks)
        silhouettes = FindSilhouettes()(scene)
        assert silhouettes.source == "masks"
        assert silhouettes.reliable.all()
        assert torch.equal(silhouettes.masks, masks)
        assert masked(scene, silhouettes) is scene
    assert FindSilhouettes(SilhouetteConfig(object="everything"))(scene).source == "everything"


def wrong(truth, kind, view):
    """Return one wrong mask of the given kind."""
    one = torch.zeros_like(truth[0])
    if kind == "inverted":
        one = ~truth[view]
    elif kind == "all":
        one = torch.ones_like(one)
    elif kind == "pixel":
        row, column = truth[view].nonzero()[truth[view].sum() // 2].tolist()
        one[row, column] = True
    else:
        one[100:, 30:90] = truth[view, 60:140, 90:150]  # an object next to the ball
    return one


@pytest.mark.parametrize(
    ("kind", "views"), [("inverted", [0, 7]), ("all", [5]), ("pixel", [0, 7]), ("another", [5])]
)
def test_masks_that_contradict_the_others_are_not_trusted(staged, kind, views):
    masks = staged.truth.clone()
    for view in views:
        masks[view] = wrong(staged.truth, kind, view)
    scene = with_masks(staged.scene, masks)
    names = ", ".join(staged.scene.views.names[view] for view in views)
    with pytest.warns(PimperWarning, match=rf"\(view {names}\): its mask contradicts.*The hull of"):
        silhouettes = FindSilhouettes()(scene)
    assert (~silhouettes.reliable).nonzero()[:, 0].tolist() == views
    used = masked(scene, silhouettes).views.masks
    assert used is not None
    for view in range(12):
        if view in views:  # the others leave the ball, and a little more at the ends of the arc
            # 86 pixels may be missing, a fifth of those of the contour.
            assert (used[view] | ~staged.truth[view]).float().mean() > 0.998
            assert overlap(used[view][None], staged.truth[view][None]) > 0.85
        else:
            assert torch.equal(used[view], staged.truth[view])


def test_masks_of_truncated_views_are_trusted(staged):
    """Half of the photographs are truncated at the middle of the ball."""
    sizes, masks = staged.scene.views.sizes_px.clone(), staged.truth.clone()
    sizes[::2, 0] = 120
    masks[::2, :, 120:] = False
    images = staged.scene.views.images.clone()
    images[::2, :, :, 120:] = 0
    views = staged.scene.views.replace(images=images, masks=masks, sizes_px=sizes)
    cameras = staged.scene.cameras.replace(sizes_px=sizes)
    scene = staged.scene.replace(views=views, cameras=cameras)
    assert FindSilhouettes()(scene).reliable.all()
    masks[4] = views.inside[4]  # the complete view
    with pytest.warns(PimperWarning, match=r"\(view 04\.png\): its mask contradicts"):
        silhouettes = FindSilhouettes()(with_masks(scene, masks))
    assert not silhouettes.inside[4, :, 120:].any()
    assert overlap(silhouettes.masks[4, :, :120][None], staged.truth[4, :, :120][None]) > 0.85


def test_masks_without_a_consistent_majority_are_rejected(staged):
    masks = staged.truth.clone()
    masks[::2] = ~masks[::2]
    with pytest.raises(InputError, match="masks contradict each other, and at most half"):
        FindSilhouettes()(with_masks(staged.scene, masks))


def test_masks_are_asked_for_and_missing(staged):
    with pytest.raises(InputError, match="the photographs have no masks"):
        FindSilhouettes(SilhouetteConfig(object="masks"))(staged.scene)


def test_silhouettes_that_contradict_each_other_are_not_trusted(staged):
    """Photographs shifted against their cameras have no common hull."""
    views = staged.scene.views
    shifted = [image.roll(90 * (view % 2) - 45, 2) for view, image in enumerate(views.images)]
    scene = staged.scene.replace(views=views.replace(images=torch.stack(shifted)))
    with pytest.warns(PimperWarning, match=r"is treated as the object.*`silhouettes.region`"):
        assert FindSilhouettes(SMALL)(scene).source == "everything"


def as_they_are(_, cuts, network):
    """Stand in for the reading of cuts by a network."""
    assert isinstance(network, nn.Module)
    return cuts


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_implausible_silhouettes_fall_back_to_everything_with_a_warning(
    staged, monkeypatch, fraction
):
    """Cuts that agree with projections of the hull by chance or not at all are rejected."""
    projections = torch.full(staged.truth.shape, -5.0)
    projections[:, 60:120, 60:180] = 5.0
    masks = torch.zeros_like(staged.truth)
    masks[:, 60:120, 180 - int(fraction * 120) : 240] = True
    nonsense = shapes.cuts_of(masks, projections)
    monkeypatch.setattr(find, "cut_in_iterations", lambda _: nonsense)
    monkeypatch.setattr(find, "read_again", as_they_are)
    overlap_percent = 100 * (fraction * 120 * 60) / ((240 - 60) * 60)
    with pytest.warns(
        PimperWarning, match=f"above the supporting plane.*by {overlap_percent:.0f}%"
    ):
        silhouettes = FindSilhouettes(SMALL)(staged.scene)
    assert silhouettes.source == "everything"
    # The ball is on z = 0; the first few hundredths are the table.
    table = torch.tensor([[0.5, 0.5, 0.0, 1.0], [0.5, -0.5, 0.05, 1.0], [0.0, 0.0, -1.0, 1.0]])
    assert ((table @ silhouettes.planes_world[0]) > 0).tolist() == [False, True, False]
    meant = FindSilhouettes(SilhouetteConfig(object="everything"))(staged.scene)
    assert len(meant.planes_world) == 0


def test_few_silhouettes_that_agree_are_not_enough(staged, monkeypatch):
    """At least half of the views must agree."""
    projections = torch.full(staged.truth.shape, -5.0)
    projections[:, 60:120, 60:180] = 5.0
    masks = projections > 0
    masks[:7, 60:120, 60:205] = True  # overlap 0.83, of which 0.83 is inside
    cuts = shapes.cuts_of(masks, projections)
    monkeypatch.setattr(find, "cut_in_iterations", lambda _: cuts)
    monkeypatch.setattr(find, "read_again", as_they_are)
    with pytest.warns(PimperWarning, match="only 5 of 12 silhouettes agree"):
        assert FindSilhouettes(SMALL)(staged.scene).source == "everything"


@pytest.mark.parametrize(
    ("grown_px", "why"),
    [(20, "show background on"), (-20, "contain [0-9]+% of the object's points")],
)
def test_silhouettes_with_a_shared_error_are_not_trusted(staged, monkeypatch, grown_px, why):
    """All views agree with hulls twice and half as wide as the ball."""
    masks = torch.stack([signed_distance(mask) for mask in staged.truth]) > -grown_px
    margins = torch.where(masks, 5.0, -5.0)

    def agreed(cues):
        return cuts_of(cues.relearned(masks), masks, margins, torch.zeros(12, dtype=torch.bool))

    monkeypatch.setattr(find, "cut_in_iterations", agreed)
    monkeypatch.setattr(find, "read_again", as_they_are)
    with pytest.warns(PimperWarning, match=why):
        assert FindSilhouettes(SMALL)(staged.scene).source == "everything"


def test_the_plane_is_learned_from_views_that_show_it(staged, generator):
    """Table pixels hidden in eight of twelve views are learned from the other four."""
    views, cameras = staged.scene.views, staged.scene.cameras
    place, _ = project(
        torch.tensor([[0.0, -0.75, 0.0]]), cameras.cam_from_world, cameras.intrinsics
    )
    away = (pixel_centers(240, 180, like=views.images) - place[:, None]).norm(dim=-1)
    hidden = away < 16
    hidden[8:] = False
    other = torch.rand(views.images.shape, generator=generator)
    images = torch.where(hidden[:, None], other, views.images)
    pictures = working_pictures(views.replace(images=images), cameras, 240)
    plane = Plane(normal_world=torch.tensor([0.0, 0, 1]), offset=torch.tensor(0.0))
    target = fixation(pictures.cameras.cam_from_world)
    before = plane_agreement(pictures, plane, target)
    after = plane_agreement(pictures, plane, target, hidden)
    centre = (away < 8) & after.isfinite()  # the table is flat elsewhere
    seen, covered = centre & (torch.arange(12) >= 8)[:, None, None], centre & hidden
    assert seen.sum() > 400
    assert (before[seen] > 0.75).float().mean() < 0.4  # occluders count as plane
    assert (after[seen] > 0.75).float().mean() > 0.9
    assert (after[covered] < 0.5).float().mean() > 0.8  # occluders are detected


def before_shifting_background(generator, num_views=9):
    """Return a disc moving over a shifting background, each photograph under its own light."""
    wide, high = 480, 360
    background = smooth(torch.rand(1, 1, 480, 600, generator=generator))
    thing = smooth(torch.rand(num_views, 1, high, wide, generator=generator))
    maps = torch.eye(3).repeat(num_views, 1, 1)
    maps[:, :2, 2] = torch.randint(0, 120, (num_views, 2), generator=generator).float()
    corner = pixel_centers(wide, high, like=background)
    covered = torch.stack(
        [(corner - corner.new_tensor([240 + 7 * view, 180])).norm(dim=-1) < 80 for view in range(9)]
    )
    seen = torch.stack(
        [
            background[0, 0, int(v) : int(v) + high, int(u) : int(u) + wide]
            for u, v in maps[:, :2, 2].tolist()
        ]
    )
    light = torch.linspace(0.5, 1.5, num_views)[:, None, None] * torch.linspace(0.6, 1, wide)
    images = torch.where(covered, thing[:, 0], seen) * light
    images = images[:, None].expand(-1, 3, -1, -1).contiguous()
    views = views_of(images, names=tuple("abcdefghi"))
    return views, maps, covered


def smooth(noise):
    return torch.nn.functional.avg_pool2d(noise, 9, 1, 4) ** 4


def test_a_mapped_static_background_is_detected(staged, generator):
    views, maps, covered = before_shifting_background(generator)
    cameras = staged.scene.cameras.take(list(range(9)))
    pictures = working_pictures(views, cameras, 240)  # at half size
    half = covered[:, ::2, ::2]
    maps[4] = torch.nan
    found = background_agreement(pictures, maps)
    background = ~torch.nn.functional.max_pool2d(half[:, None].float(), 13, 1, 6)[:, 0].bool()
    known = background & found.isfinite()
    assert found[4].isnan().all()
    assert known[:4].float().mean() > 0.5
    assert (found[known] > 0.75).float().mean() > 0.95
    inside = half & found.isfinite()
    assert (found[inside] > 0.75).float().mean() < 0.03
    wrong = background_agreement(pictures, torch.eye(3).repeat(9, 1, 1))
    assert (wrong[wrong.isfinite()] > 0.75).float().mean() < 0.2


def test_a_shifting_background_is_detected_unless_the_camera_moves(staged, generator):
    views, maps, covered = before_shifting_background(generator)
    pictures = working_pictures(views, staged.scene.cameras.take(list(range(9))), 240)
    found = static_background_maps(pictures, covered[:, ::2, ::2])
    shifts = (found[:, :2, 2] - maps[:, :2, 2]).float()
    assert (shifts - shifts[0]).abs().max() <= 2.5  # a pixel of the reduced photographs and a half
    pictures = working_pictures(staged.scene.views, staged.scene.cameras, 240)
    assert len(static_background_maps(pictures, staged.truth)) == 0


def test_the_object_is_limited_to_the_region(staged):
    left = SilhouetteConfig(size_px=240, region=(-0.6, -0.6, 0.0, 0.0, 0.6, 1.1))
    silhouettes = FindSilhouettes(left)(staged.scene)
    assert silhouettes is not None
    assert 0 < silhouettes.masks.sum() < 0.8 * staged.truth.sum()  # half a ball, cut by the box


def test_a_region_is_two_corners():
    for wrong in ((1.0, 2.0), (0.0, 0.0, 0.0, 1.0, -1.0, 1.0)):
        with pytest.raises(ConfigError, match="region"):
            SilhouetteConfig(region=wrong)


def test_a_region_outside_all_views_is_rejected(staged):
    away = SilhouetteConfig(size_px=240, region=(50.0, 50.0, 50.0, 51.0, 51.0, 51.0))
    with pytest.raises(
        InputError, match="no photograph shows it, and no point of the cloud is in it"
    ):
        FindSilhouettes(away)(staged.scene)
    tiny = SilhouetteConfig(size_px=240, region=(0.0, 0.0, 0.4, 1e-6, 1e-6, 0.400001))
    with pytest.warns(PimperWarning, match="Everything"):  # visible, but without points
        FindSilhouettes(tiny)(staged.scene)


@pytest.fixture
def numbers(staged):
    """Return a function from the scene of a capture session to the numbers of its views."""
    names = staged.scene.views.names
    return lambda part: [names.index(name) for name in part.views.names]


def numbered(part, views):
    """Return silhouettes with the number of each view as value."""
    inside = torch.tensor(views).float()[:, None, None] * torch.ones_like(part.views.images[:, 0])
    return Silhouettes(inside=inside, reliable=torch.tensor(views) > 2, source="found")


def test_silhouettes_of_sessions_are_in_the_order_of_views(staged, numbers):
    scene = staged.scene
    count = scene.views.num_views
    sessions = torch.arange(count) % 2
    asked = []

    def find(part):
        assert len(part.sessions) == 0
        asked.append(numbers(part))
        found = numbered(part, numbers(part))
        return found.replace(hidden=found.inside > 0) if 0 in numbers(part) else found

    found = by_session(scene.replace(sessions=sessions), find)
    assert asked == [list(range(0, count, 2)), list(range(1, count, 2))]
    assert found.inside[:, 0, 0].tolist() == list(range(count))
    assert found.reliable.tolist() == [view > 2 for view in range(count)]
    assert found.source == "found"
    assert found.hidden[:, 0, 0].tolist() == [view > 0 and view % 2 == 0 for view in range(count)]


def test_without_sessions_all_views_are_processed_together(staged, numbers):
    scene = staged.scene
    found = by_session(scene, lambda part: numbered(part, numbers(part)))
    assert found.inside[:, 0, 0].tolist() == list(range(scene.views.num_views))


def test_one_session_without_silhouettes_discards_all(staged, numbers):
    scene = staged.scene

    def find(part):
        views = numbers(part)
        return numbered(part, views) if 0 in views else Silhouettes.everything(part.views)

    sessions = torch.arange(scene.views.num_views) % 2
    found = by_session(scene.replace(sessions=sessions), find)
    assert found.source == "everything"
    assert len(found.inside) == scene.views.num_views


def test_everything_is_bounded_by_the_planes_of_all_sessions(staged, numbers):
    scene = staged.scene
    sessions = torch.arange(scene.views.num_views) % 2

    def find(part):
        plane = torch.tensor([[0.0, 0.0, 1.0, float(numbers(part)[0])]])
        return Silhouettes.everything(part.views, plane)

    found = by_session(scene.replace(sessions=sessions), find)
    assert found.planes_world[:, 3].tolist() == [0.0, 1.0]
