import itertools

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from sparse_models import views_of
from torch.testing import assert_close

from pimper_torch.geometry.projection import project
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Silhouettes
from pimper_torch.viz.overview import (
    RELIABLE,
    UNRELIABLE,
    border,
    draw_overview,
    headline,
    panels_of,
    preview,
    shown_views,
    thumbnail_sheet,
)
from pimper_torch.viz.render import crop_to, shade


def drawn(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(np.float32) / 255


def thumbnail(picture):
    """Downscale to a few pixels, to ignore resampling and rounding."""
    rgb = Image.fromarray((255 * picture).round().astype(np.uint8))
    return np.asarray(rgb.resize((6, 4), Image.Resampling.BOX)).astype(np.float32) / 255


def test_all_images_are_different_and_on_the_sheet(reconstruction, tmp_path):
    draw_overview(reconstruction, tmp_path / "overview.png", 120)
    shown = panels_of(reconstruction, 120)
    assert len(shown) == 8
    assert shown[0].title == "photograph b.png"
    whole = drawn(tmp_path / "overview.png")
    for index, tile in enumerate(shown):
        rows, columns = tile.picture.shape[:2]
        left = 10 + index % 4 * 130
        strip = whole[:, left : left + columns]
        apart = [
            np.abs(strip[top : top + rows] - tile.picture).max() for top in range(len(strip) - rows)
        ]
        assert (columns, min(apart)) == (120, pytest.approx(0, abs=0.003))  # eight bits
    pairs = itertools.combinations([thumbnail(tile.picture) for tile in shown], 2)
    assert min(np.abs(one - other).max() for one, other in pairs) > 0.06


def test_facets_are_drawn_at_their_projected_corners(reconstruction):
    """The photograph is white at the projected corners: each white spot has a drawn corner."""
    cameras, coarse = reconstruction.cameras, reconstruction.coarse.mesh
    pixels, _ = project(coarse.vertices_world, cameras.cam_from_world[1], cameras.intrinsics[1])
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(60) + 0.5, indexing="ij")
    away = (torch.stack([x, y], dim=-1)[:, :, None] - pixels).norm(dim=-1).amin(dim=-1)
    views = reconstruction.scene.views
    images = (away < 1.2).float().expand(3, 3, 40, 60)
    scene = reconstruction.scene.replace(views=views.replace(images=images))
    photograph, facets = (
        tile.picture for tile in panels_of(reconstruction.replace(scene=scene), 300)[:2]
    )
    yellow = (facets[..., 0] > 0.5) & (facets[..., 2] < 0.7 * facets[..., 0])
    spots, count = ndimage.label(photograph[..., 0] > 0.5)
    assert count >= 2
    for spot in range(1, count + 1):
        assert (yellow & (spots == spot)).any()
    dark = facets[~yellow & (photograph[..., 0] > 0.9)]
    assert len(dark) == 0 or dark.max() < 0.7  # lines and object are both visible


def test_a_grey_result_without_normals_and_albedo_is_drawn(reconstruction, tmp_path):
    views = reconstruction.scene.views
    grey = reconstruction.scene.replace(views=views.replace(images=views.images[:, :1]))
    bare = reconstruction.mesh.replace(normals_world=None, albedo=None, confidence=None)
    draw_overview(reconstruction.replace(scene=grey, mesh=bare), tmp_path / "overview.png", 60)
    sheet = drawn(tmp_path / "overview.png")
    shown = thumbnail(sheet[70:100, 12:60])
    assert np.allclose(shown[..., :1], shown, atol=0.01)  # the photograph is grey
    assert sheet.std() > 0.1


def test_silhouettes_are_drawn_over_the_photograph_and_all_views_below(reconstruction, tmp_path):
    inside = torch.zeros(3, 40, 60)
    inside[:, 10:30, 20:40] = 1.0
    reliable = torch.tensor([True, False, True])
    silhouettes = Silhouettes(inside=inside, reliable=reliable, source="found")
    outlined = reconstruction.replace(silhouettes=silhouettes)
    marked, bare = panels_of(outlined, 60)[0].picture, panels_of(reconstruction, 60)[0].picture
    assert 20 < (marked != bare).any(axis=-1).sum() < 400
    draw_overview(outlined, tmp_path / "outlined.png", 200)
    draw_overview(reconstruction, tmp_path / "bare.png", 200)
    with Image.open(tmp_path / "outlined.png") as tall, Image.open(tmp_path / "bare.png") as low:
        assert tall.size[0] == low.size[0]
        assert tall.size[1] > low.size[1] + 100
        below = np.asarray(tall.convert("RGB"))[low.size[1] :].astype(int)
    red = (below[..., 0] > 200) & (below[..., 1:] < 90).all(-1)
    yellow = (below[..., 0] > 200) & (below[..., 1] > 170) & (below[..., 2] < 130)
    assert red.sum() > 100
    assert yellow.sum() > 1.5 * red.sum()  # two views are reliable, one is not


@pytest.mark.parametrize("count", [1, 64, 65, 300])
def test_all_views_or_a_selection_with_all_unreliable_ones_are_shown(count):
    reliable = torch.ones(count, dtype=torch.bool)
    reliable[count // 2] = False
    shown = shown_views(reliable)
    assert len(shown) == len(set(shown)) == min(count, 64)
    assert shown == sorted(shown)
    assert count // 2 in shown
    assert shown[0] == 0
    assert shown[-1] == count - 1
    assert max((b - a for a, b in itertools.pairwise(shown)), default=1) <= -(-count // 62)
    assert len(shown_views(torch.zeros(count, dtype=torch.bool))) == min(count, 64)


def test_records_with_gradients_are_drawn(reconstruction, tmp_path):
    vertices = reconstruction.mesh.vertices_world.clone().requires_grad_()
    mesh = reconstruction.mesh.replace(vertices_world=vertices)
    draw_overview(reconstruction.replace(mesh=mesh), tmp_path / "overview.png", 60)
    draw_overview(reconstruction, tmp_path / "without.png", 60)
    assert np.array_equal(drawn(tmp_path / "overview.png"), drawn(tmp_path / "without.png"))


def test_the_headline_counts(reconstruction):
    assert headline(reconstruction) == "3 of 4 photographs, 2 facets, 225 vertices, 2 s"
    doubted = reconstruction.replace(scene=reconstruction.scene.replace(diagnosis="All is flat."))
    assert headline(doubted).startswith("3 of 4 photographs (cameras unreliable), 2 facets")


def test_the_photograph_and_three_views_of_the_surface_are_side_by_side(reconstruction, tmp_path):
    path = tmp_path / "preview.png"
    coarse = reconstruction.coarse
    preview(reconstruction.scene, coarse.mesh, coarse.reference, 90).save(path)
    sheet = drawn(path)
    assert sheet.shape[0] == 90
    own = reconstruction.cameras.take([coarse.reference])
    front = shade(coarse.mesh, crop_to(own, coarse.mesh.vertices_world, 90, 0.05)).numpy()
    width, height = own.sizes_px[0].tolist()
    left, top = round(90 * width / height), (90 - front.shape[0]) // 2
    found = sheet[top : top + front.shape[0], left : left + front.shape[1]]
    assert np.abs(found - front).max() <= 0.5 / 255 + 1e-6  # rounding to bytes
    image = reconstruction.scene.views.images[coarse.reference]
    assert sheet[:, :left].mean() ** 2.2 == pytest.approx(float(image.mean()), abs=0.1)
    sides = sheet[:, left + front.shape[1] :]
    assert sides.min() < 0.9  # the sides are not empty


def test_the_border_of_a_square_is_its_outermost_pixels():
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[2:7, 2:7] = True
    wanted = mask.clone()
    wanted[3:6, 3:6] = False
    assert torch.equal(border(mask), wanted)
    assert not border(torch.ones_like(mask)).any()  # the image's edge does not count


def test_every_view_has_its_tile_and_its_silhouette():
    images = torch.linspace(0.1, 0.5, 3)[:, None, None, None].expand(3, 1, 40, 60)
    views = views_of(images)
    inside = torch.zeros(3, 40, 60)
    for view in range(3):
        inside[view, 10:30, 20 : 30 + 10 * view] = 0.9
    reliable = torch.tensor([True, True, False])
    silhouettes = Silhouettes(inside=inside, reliable=reliable, source="found")
    sheet = thumbnail_sheet(views, silhouettes, range(3), width_px=60, across=2)
    assert sheet.shape == (40, 60, 3)  # two rows of two tiles of 30 x 20
    assert_close(sheet[20:, 30:], torch.ones(20, 30, 3))
    for view, colour in enumerate((RELIABLE, RELIABLE, UNRELIABLE)):
        top, left = 20 * (view // 2), 30 * (view % 2)
        tile = sheet[top : top + 20, left : left + 30]
        drawn = (tile - torch.tensor(colour)).abs().amax(dim=-1) < 1e-6
        wanted = torch.zeros(20, 30, dtype=torch.bool)
        wanted[5:15, 10 : 15 + 5 * view] = True
        assert torch.equal(drawn, border(wanted))
        grey = srgb_from_linear(images[view, 0, 0, 0])
        assert_close(tile[~drawn], grey.expand(int((~drawn).sum()), 3))
    last = thumbnail_sheet(views, silhouettes, [2, 0], width_px=60, across=2)
    assert torch.equal(last, torch.cat([sheet[20:, :30], sheet[:20, :30]], dim=1))


def test_before_there_is_a_surface_the_points_are_drawn_in_their_colours(reconstruction, tmp_path):
    path, scene = tmp_path / "preview.png", reconstruction.scene
    grid = torch.linspace(-0.5, 0.5, 20)
    points = torch.cartesian_prod(grid, grid, torch.zeros(1))
    far = torch.tensor([[100.0, 0, 0]])
    none = scene.observation_point[:0]
    scene = scene.replace(
        points_world=torch.cat([points, far]),
        reprojection_errors_px=torch.zeros(401),
        observation_point=none,
        observation_view=none,
        observation_pixels=scene.observation_pixels[:0],
    )
    preview(scene, None, 0, 90).save(path)
    sheet = drawn(path)
    width, height = scene.cameras.sizes_px[0].tolist()
    dots = (sheet[:, round(90 * width / height) :] == 0).all(axis=-1)  # points that nobody observed
    # Four pixels for each of 324 points; with the far point, all of them would be in a few pixels.
    assert dots.mean() > 0.1
