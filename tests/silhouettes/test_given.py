"""Masks that contradict their photographs are refused, with the likely cause."""

import re
import warnings

import pytest
import torch
from scenes import observed, observing
from sparse_models import views_of
from torch.nn.functional import normalize

import pimper_torch as pt
from pimper_torch.chains.prepare import locate
from pimper_torch.geometry.projection import project
from pimper_torch.io.decode import rotated
from pimper_torch.records import CameraModel
from pimper_torch.stages.silhouettes.given import contradictory, refuse_wrong_masks
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


def order(*changed):
    """Return names in order, with some changed."""
    return torch.tensor([dict(changed).get(view, view) for view in range(VIEWS)])


NEEDED = r"Needed: masks that are bright at the object \(or `--mask-object dark`\), oriented like"
DARK = "inverted: they show the object dark"
ODD = r"01\.png, 03\.png, 05\.png, 07\.png and 6 more"


def accept(scene, views):
    refuse_wrong_masks(scene.replace(views=views))


def refuse(scene, views, cause):
    """Check the cause that the error gives."""
    found = r"The masks contradict [0-9.]+% of the points, but 0\.[0-9]% if they are "
    with pytest.raises(pt.InputError, match=found + cause + r"\. " + NEEDED):
        accept(scene, views)


def alternately(masks, others):
    odd = torch.arange(VIEWS) % 2 > 0
    return torch.where(odd[:, None, None], others, masks)


def exchanged(*pairs):
    """Return the text that names other photographs for some files."""
    listed = [f"{a:02d}.png shows {b:02d}.png" for a, b in pairs]
    more = f" and {len(listed) - 4} more" if len(listed) > 4 else ""
    return re.escape(f"named after other photographs ({', '.join(listed[:4])}{more})")


def moved(masks, right, down):
    return torch.roll(masks, (down, right), (1, 2))


@pytest.mark.parametrize("form", [hard, soft])
@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        (lambda masks: ~masks, DARK),
        (lambda masks: alternately(masks, ~masks), rf"{DARK} \({ODD}\)"),
        (lambda masks: masks.flip(1, 2), "turned by a half turn"),
        (lambda masks: masks.flip(2), "mirrored"),
        (lambda masks: masks.flip(1), "mirrored upside down"),
        (lambda masks: alternately(masks, masks.flip(1, 2)), rf"turned by a half turn \({ODD}\)"),
        (lambda masks: masks[order((3, 11), (11, 3))], exchanged((3, 11), (11, 3))),
        (
            lambda masks: masks[order((3, 11), (11, 3), (5, 14), (14, 5))],
            exchanged((3, 11), (5, 14), (11, 3), (14, 5)),
        ),
        (lambda masks: masks.flip(0), exchanged(*((x, VIEWS - 1 - x) for x in range(VIEWS)))),
        (lambda masks: masks.roll(7, 0), exchanged(*((x, (x - 7) % VIEWS) for x in range(VIEWS)))),
        (
            lambda masks: masks.flip(0, 2),
            "mirrored and " + exchanged(*((x, VIEWS - 1 - x) for x in range(VIEWS))),
        ),
        (lambda masks: moved(masks, 12, 0), "moved by about 12 pixels to the right"),
        (
            lambda masks: moved(masks, -8, 10),
            "moved by about 8 pixels to the left and 10 pixels down",
        ),
    ],
)
def test_masks_of_other_pixels_are_refused_with_their_cause(scene, truth, form, wrong, cause):
    refuse(scene, form(scene.views, wrong(truth)), cause)


def test_correct_and_slightly_inaccurate_masks_are_accepted(scene, truth):
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
        accept(scene, views)


def test_shifted_names_of_some_soft_masks_are_refused(scene, truth):
    prior = soft(scene.views, truth).priors[0].take(list(range(12))).replace(names=NAMES[1:13])
    views = scene.views.replace(priors=(prior,))
    refuse(scene, views, exchanged(*((file, file - 1) for file in range(1, 13))))


def test_only_inverted_masks_are_detected_on_an_untextured_object(scene, truth):
    bare = observing(scene, scene.observation_point >= len(scene.points_world) - 300)
    with pytest.warns(pt.PimperWarning, match="No point of the cloud is in the silhouettes"):
        accept(bare, hard(scene.views, truth))
    with pytest.raises(pt.InputError, match="if they are inverted"):
        accept(bare, soft(scene.views, ~truth))


def test_without_a_cloud_masks_are_compared_with_their_hull(scene, truth):
    bare = observing(scene, slice(0))
    accept(bare, hard(scene.views, truth))
    assert not contradictory(bare.replace(views=hard(scene.views, truth))).any()
    masks = truth.clone()
    masks[3], masks[11] = ~masks[3], moved(masks[11:12], 0, 40)[0]
    wrong = bare.replace(views=hard(scene.views, masks))
    refuse_wrong_masks(wrong)
    assert contradictory(wrong).nonzero()[:, 0].tolist() == [3, 11]


def test_a_mask_that_contradicts_the_points_is_said_and_replaced(scene, truth):
    masks = truth.clone()
    masks[4] = moved(truth[4:5], 16, 0)[0]
    wrong = scene.replace(views=hard(scene.views, masks))
    with pytest.warns(pt.PimperWarning, match=r"of the points, most in 04\.png \([0-9]+%\)"):
        refuse_wrong_masks(wrong)
    assert contradictory(wrong).nonzero()[:, 0].tolist() == [4]


def test_masks_of_an_object_that_fills_its_photographs_are_accepted(scene, truth):
    """Its masks touch the borders; a cloud may have as many wrong points inside."""
    filling = hard(scene.views, torch.ones_like(truth))
    filling.masks[:, :9, :9] = False
    accept(scene, filling)


@pytest.mark.parametrize("form", [hard, soft])
def test_masks_that_contradict_points_in_any_reading_are_rejected(scene, truth, form):
    moved = [mask.roll((17 * view % 61, 23 * view % 83), (0, 1)) for view, mask in enumerate(truth)]
    views = form(scene.views, torch.stack(moved))
    with pytest.raises(pt.InputError, match=r"contradict [0-9]+% of the points in the median view"):
        accept(scene, views)


@pytest.mark.parametrize(
    ("turn", "upright", "cause"),
    [
        (5, 5, "mirrored and turned by a quarter turn"),
        (8, 6, "turned by a quarter turn anticlockwise"),
        (7, 7, "mirrored and turned by a quarter turn"),
        (6, 8, "turned by a quarter turn clockwise"),
    ],
)
def test_quarter_turns_of_square_masks_are_refused(scene, truth, turn, upright, cause):
    """Photographs are cropped to squares; their soft masks keep their size."""
    cut = slice((WIDTH - HEIGHT) // 2, (WIDTH + HEIGHT) // 2)
    sizes, cameras = torch.tensor([[HEIGHT, HEIGHT]] * VIEWS), scene.cameras
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, 0, 2] -= cut.start
    masks = truth[:, :, cut]
    views = scene.views.replace(images=scene.views.images[..., cut], sizes_px=sizes)
    files = [torch.from_numpy(rotated(mask.numpy(), turn)) for mask in masks]
    restored = [torch.from_numpy(rotated(mask.numpy(), upright)) for mask in files]
    assert torch.equal(torch.stack(restored), masks)
    views = soft(views, torch.stack(files))
    square = scene.replace(cameras=cameras.replace(intrinsics=intrinsics, sizes_px=sizes))
    refuse(square, views, cause)


class Placed(pt.Stage):
    """Known cameras instead of structure from motion."""

    def __init__(self, scene):
        super().__init__()
        self.scene, self.asked = scene, []

    def forward(self, views, sparse_model=None):
        self.asked.append(views)
        return self.scene.replace(views=views)


def test_a_chain_refuses_wrong_masks_beside_photographs_and_beside_cameras(scene, truth):
    stage, views = Placed(scene), hard(scene.views, truth.flip(1, 2))
    chain = pt.CoarseToFine(reconstruct=stage)
    for given in (views, scene.replace(views=views)):
        with pytest.raises(pt.InputError, match="if they are turned by a half turn"):
            locate(chain, chain.running(), given)
    assert stage.asked == [views]
    right = hard(scene.views, truth)
    assert torch.equal(locate(chain, chain.running(), right)[0].views.masks, truth)


def test_a_chain_without_silhouettes_ignores_masks(scene, truth):
    config = pt.CoarseToFineConfig(silhouettes=SilhouetteConfig(object="everything"))
    chain, views = pt.CoarseToFine(config), hard(scene.views, ~truth)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        placed = locate(chain, chain.running(), scene.replace(views=views))[0]
    assert torch.equal(placed.views.masks, ~truth)
