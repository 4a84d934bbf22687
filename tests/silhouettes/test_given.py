"""Masks stored in a different way than their photographs."""

import warnings

import pytest
import torch
from scenes import observed, observing
from sparse_models import views_of
from torch.nn.functional import normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.chains.prepare import locate
from pimper_torch.geometry.projection import project
from pimper_torch.io.decode import rotated
from pimper_torch.records import CameraModel
from pimper_torch.stages.silhouettes.given import AS_THEY_ARE, Reading, right_reading
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig
from tests.silhouettes.shapes import FOCAL, HEIGHT, WIDTH, all_round, silhouettes_of

# Three balls without symmetry, and the radius of background points.
CENTERS = torch.tensor([[-0.4, 0.0, 0.0], [0.6, 0.3, 0.2], [0.0, 0.2, 0.7]]).double()
RADII, FAR, VIEWS = torch.tensor([0.5, 0.3, 0.2]).double(), 1.3, 20
NAMES = tuple(f"{view:02d}.png" for view in range(VIEWS))


def balls(points):
    return ((points[..., None, :] - CENTERS).norm(dim=-1) - RADII).amin(dim=-1)


@pytest.fixture(scope="module")
def truth():
    return silhouettes_of(balls, all_round()).masks


@pytest.fixture(scope="module")
def scene(truth):
    """Return points of the balls, observed by views they face, and unoccluded points around."""
    generator, cameras = torch.Generator().manual_seed(3), all_round()
    outward = normalize(torch.randn(900, 3, generator=generator).double(), dim=1)
    ball = torch.arange(600) % 3
    points = CENTERS[ball] + RADII[ball, None] * outward[:600]
    bare = balls(points) > -1e-6  # not inside another ball
    points = torch.cat([points[bare], FAR * outward[600:]])
    outward = torch.cat([outward[:600][bare], outward[600:]])
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    column, row = pixels.long().unbind(dim=-1)
    framed = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    inside = truth[
        torch.arange(VIEWS)[:, None], row.clamp(0, HEIGHT - 1), column.clamp(0, WIDTH - 1)
    ]
    away = cameras.centers_world[:, None] - points
    faces = (normalize(away, dim=-1) * outward).sum(dim=-1) > 0.2
    on_ball = torch.arange(len(points)) < len(points) - 300
    # A ball may hide points of a different ball; they are inside its silhouette anyway.
    seen = framed & torch.where(on_ball, faces & inside, ~inside)
    middle = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    lens = CameraModel(camera=1, model="PINHOLE", params=middle, width=WIDTH, height=HEIGHT)
    orientations = torch.tensor([1, 3] * (VIEWS // 2))
    images = torch.full((VIEWS, 3, HEIGHT, WIDTH), 0.2)
    views = views_of(images, names=NAMES, orientations=orientations)
    return observed(views, cameras, points, pixels, seen, lens)


def hard(views, masks):
    return views.replace(masks=masks)


def soft(views, masks):
    """Return masks like those of a segmenter: never certain."""
    inside = torch.where(masks, 0.9, 0.05)
    prior = pt.SilhouettePrior(names=views.names, sizes_px=views.sizes_px, inside=inside)
    return views.replace(masks=None, priors=(prior,))


def read(views, reading):
    """Return the masks in a reading."""
    found = reading.of(views)
    return found.priors[0].inside > 0.5 if found.masks is None else found.masks


def order(*changed):
    """Return names in order, with some changed."""
    return torch.tensor([dict(changed).get(view, view) for view in range(VIEWS)])


@pytest.mark.parametrize("form", [hard, soft])
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (torch.logical_not, "inverted"),
        (lambda masks: masks.flip(1, 2), "turned by a half turn"),
        (lambda masks: masks.flip(2), "mirrored"),
        (lambda masks: masks.flip(1), "mirrored upside down"),
        (
            lambda masks: torch.stack([masks, masks.flip(1, 2)], dim=1)[
                torch.arange(VIEWS), torch.arange(VIEWS) % 2
            ],
            "in the stored orientation, not turned by EXIF",
        ),
        (lambda masks: masks[order((3, 11), (11, 3))], r"exchanged between (03|11)\.png and"),
        (
            lambda masks: masks.roll(7, 0),
            r"shifted by 7 in the list \(00\.png has that of 07\.png\)",
        ),
    ],
)
def test_cameras_and_points_select_the_reading_of_masks(scene, truth, form, wrong, said):
    views = form(scene.views, wrong(truth))
    with pytest.warns(pt.PimperWarning, match=f"if they are {said}.*, so they are read like that"):
        reading = right_reading(scene.replace(views=views), views)
    assert torch.equal(read(views, reading), truth)
    if form is soft:  # with the same certainty
        inside = reading.of(views).priors[0].inside
        assert_close((inside - 0.5).abs().sum(), (views.priors[0].inside - 0.5).abs().sum())


def test_correct_and_slightly_inaccurate_masks_are_unchanged(scene, truth):
    """Masks alternately a pixel too wide and too narrow, and those of four photographs only."""
    wide = torch.nn.functional.max_pool2d(truth.float(), 3, 1, 1) > 0
    narrow = torch.nn.functional.max_pool2d((~truth).float(), 3, 1, 1) == 0
    drawn = torch.where((torch.arange(VIEWS) % 2 > 0)[:, None, None], wide, narrow)
    few = soft(scene.views, truth).priors[0].take([1, 6, 9, 15])
    for views in (
        hard(scene.views, truth),
        soft(scene.views, truth),
        hard(scene.views, drawn),
        scene.views.replace(priors=(few,)),
        scene.views,
    ):
        assert right_reading(scene.replace(views=views), views) is AS_THEY_ARE


def test_shifted_names_of_soft_masks_are_corrected(scene, truth):
    prior = soft(scene.views, truth).priors[0].take(list(range(12))).replace(names=NAMES[1:13])
    views = scene.views.replace(priors=(prior,))
    with pytest.warns(pt.PimperWarning, match=r"shifted by 1 in the list \(00\.png has that of 01"):
        (found,) = right_reading(scene.replace(views=views), views).of(views).priors
    order = [found.names.index(name) for name in NAMES[:12]]
    assert len(found.names) == 12
    assert torch.equal(found.inside[order], prior.inside)


def test_clicks_are_unchanged(scene, truth):
    """This includes photographs of different sizes, with rasters padded by 0."""
    inside = torch.full((2, 40, 60), 0.5)
    inside[0, :, 50:], inside[:, 10:13, 20:23] = 0, 1
    sizes = torch.tensor([[50, 40], [60, 40]])
    click = pt.SilhouettePrior(names=NAMES[2:4], sizes_px=sizes, inside=inside)
    views = soft(scene.views, truth)
    views = views.replace(priors=(click, *views.priors))
    kept, inverted = Reading(inverted=True).of(views).priors
    assert kept is click
    assert torch.equal(inverted.inside > 0.5, ~truth)


def test_only_inverted_masks_are_detected_on_an_untextured_object(scene, truth):
    bare = observing(scene, scene.observation_point >= len(scene.points_world) - 300)
    for wrong in (truth, truth.flip(1, 2)):
        views = hard(scene.views, wrong)
        with pytest.warns(pt.PimperWarning, match="No point of the cloud is in the silhouettes"):
            assert right_reading(bare.replace(views=views), views) is AS_THEY_ARE
    views = soft(scene.views, ~truth)
    with pytest.warns(pt.PimperWarning, match="if they are inverted"):
        assert right_reading(bare.replace(views=views), views).inverted


def test_without_a_cloud_only_masks_are_compared(scene, truth):
    bare, views = observing(scene, slice(0)), hard(scene.views, truth)
    assert right_reading(bare.replace(views=views), views) is AS_THEY_ARE
    views = hard(scene.views, truth[order((3, 11), (11, 3))])
    with pytest.warns(pt.PimperWarning, match=r"exchanged between (03|11)\.png"):
        reading = right_reading(bare.replace(views=views), views)
    assert torch.equal(read(views, reading), truth)


def test_masks_of_an_object_that_fills_its_photographs_are_not_inverted(scene, truth):
    """Its masks touch the borders; a cloud may have as many wrong points inside."""
    filling = hard(scene.views, torch.ones_like(truth))
    filling.masks[:, :9, :9] = False
    assert right_reading(scene.replace(views=filling), filling) is AS_THEY_ARE


@pytest.mark.parametrize("form", [hard, soft])
def test_masks_that_contradict_points_in_any_reading_are_rejected(scene, truth, form):
    moved = [mask.roll((17 * view % 61, 23 * view % 83), (0, 1)) for view, mask in enumerate(truth)]
    views = form(scene.views, torch.stack(moved))
    with pytest.raises(pt.InputError, match=r"contradict [0-9]+% of the points in the median view"):
        right_reading(scene.replace(views=views), views)


@pytest.mark.parametrize("turn", range(1, 9))
def test_masks_are_rotated_like_photographs(turn):
    masks = torch.rand(2, 5, 7, generator=torch.Generator().manual_seed(turn)) > 0.5
    files = dict(zip("ab", masks, strict=True))
    found = Reading(turns={"b": turn}).masks(files, files, torch.logical_not)
    assert torch.equal(found["a"], masks[0])
    assert torch.equal(found["b"], torch.from_numpy(rotated(masks[1].numpy(), turn)))


def test_quarter_turns_of_square_masks_are_detected(scene, truth):
    """Photographs are cropped to squares; their soft masks keep their size."""
    cut = slice((WIDTH - HEIGHT) // 2, (WIDTH + HEIGHT) // 2)
    sizes, cameras = torch.tensor([[HEIGHT, HEIGHT]] * VIEWS), scene.cameras
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, 0, 2] -= cut.start
    upright = truth[:, :, cut]
    views = scene.views.replace(images=scene.views.images[..., cut], sizes_px=sizes)
    views = soft(views, upright.mT.flip(1))
    square = scene.replace(
        views=views, cameras=cameras.replace(intrinsics=intrinsics, sizes_px=sizes)
    )
    with pytest.warns(pt.PimperWarning, match="turned by a quarter turn anticlockwise"):
        reading = right_reading(square, views)
    assert torch.equal(read(views, reading), upright)


class Placed(pt.Stage):
    """Known cameras instead of structure from motion."""

    def __init__(self, scene):
        super().__init__()
        self.scene, self.asked = scene, []

    def forward(self, views, sparse_model=None):
        self.asked.append(views)
        return self.scene.replace(views=views)


def test_a_chain_recomputes_cameras_with_the_corrected_masks(scene, truth):
    stage, views = Placed(scene), hard(scene.views, truth.flip(1, 2))
    chain = pt.CoarseToFine(reconstruct=stage)
    with pytest.warns(pt.PimperWarning, match="half turn"):
        placed = locate(chain, chain.running(), views)[0]
    assert torch.equal(stage.asked[0].masks, views.masks)
    assert torch.equal(stage.asked[1].masks, truth)
    assert torch.equal(placed.views.masks, truth)
    with pytest.warns(pt.PimperWarning, match="half turn"):
        given = locate(chain, chain.running(), scene.replace(views=views))[0]
    assert torch.equal(given.views.masks, truth)
    assert len(stage.asked) == 2


def test_a_chain_without_silhouettes_ignores_masks(scene, truth):
    config = pt.CoarseToFineConfig(silhouettes=SilhouetteConfig(object="everything"))
    chain, views = pt.CoarseToFine(config), hard(scene.views, ~truth)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        placed = locate(chain, chain.running(), scene.replace(views=views))[0]
    assert torch.equal(placed.views.masks, ~truth)
