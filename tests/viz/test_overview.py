import itertools
import warnings

import numpy as np
import torch
from PIL import Image

from pimper_torch.records import Silhouettes
from pimper_torch.viz.overview import Panel, _boxes, draw_overview, headline, panels


def drawn(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(np.float32) / 255


def thumbnail(picture):
    """Shrink to a few pixels, in which resampling and rounding no longer count."""
    rgb = Image.fromarray((255 * picture).round().astype(np.uint8))
    return np.asarray(rgb.resize((6, 4), Image.Resampling.BOX)).astype(np.float32) / 255


def test_every_panel_is_drawn_in_its_box(reconstruction, tmp_path):
    draw_overview(reconstruction, tmp_path / "overview.png", 120)
    sheet, shown = drawn(tmp_path / "overview.png"), panels(reconstruction, 120)
    height, width = sheet.shape[:2]
    for panel, (left, bottom, wide, tall) in zip(shown, _boxes(shown)[0], strict=True):
        rows, columns = panel.picture.shape[:2]
        scale = min(wide * width / columns, tall * height / rows)
        middle, top = (left + wide / 2) * width, (1 - bottom - tall) * height
        at = slice(round(top), round(top + scale * rows))
        across = slice(round(middle - scale * columns / 2), round(middle + scale * columns / 2))
        found = thumbnail(sheet[at, across])
        if panel.lines is None:  # facets are drawn over the other
            assert np.abs(found - thumbnail(panel.picture)).max() < 0.06  # a pixel of the border
    pictures = [thumbnail(panel.picture) for panel in shown]
    pairs = itertools.combinations(pictures, 2)
    assert min(np.abs(one - other).max() for one, other in pairs) > 0.06  # or any box would do


def test_facets_lie_where_the_photograph_shows_their_corners(reconstruction):
    shown = panels(reconstruction, 120)
    assert len(shown) == 8
    assert "b.png" in shown[0].title
    for panel in shown:
        assert panel.picture.shape[2] == 3
        assert 0 <= panel.picture.min() < panel.picture.max() <= 1
    photograph, facets = shown[0].picture, shown[1]
    dimming = facets.picture.sum() / photograph.sum()
    assert 0.3 < dimming < 0.7  # lines stand out, and the object is still seen
    assert np.allclose(facets.picture, dimming * photograph, atol=1e-5)

    image = reconstruction.scene.views.images[1]
    whole = torch.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)
    rows, columns = photograph.shape[:2]
    windows = whole.unfold(1, rows, 1).unfold(2, columns, 1).permute(1, 2, 3, 4, 0)
    apart = (windows - torch.from_numpy(photograph)).abs().amax(dim=(2, 3, 4))
    ((top, left),) = (apart < 1e-4).nonzero().tolist()  # the crop is found in one position
    cameras, coarse = reconstruction.cameras, reconstruction.coarse.mesh
    pose, corners = cameras.cam_from_world[1], coarse.vertices_world[coarse.faces]
    in_cam = corners @ pose[:3, :3].mT + pose[:3, 3]
    pixels = (in_cam @ cameras.intrinsics[1].mT)[..., :2] / in_cam[..., 2:]
    expected = pixels - torch.tensor([left, top])
    assert np.allclose(facets.lines, expected, atol=1e-3)  # float32, hundredths of a pixel


def test_a_grey_result_without_normals_and_albedo_is_drawn_too(reconstruction, tmp_path):
    views = reconstruction.scene.views
    grey = reconstruction.scene.replace(views=views.replace(images=views.images[:, :1]))
    bare = reconstruction.mesh.replace(normals_world=None, albedo=None, confidence=None)
    draw_overview(reconstruction.replace(scene=grey, mesh=bare), tmp_path / "overview.png", 60)
    sheet = drawn(tmp_path / "overview.png")
    shown = thumbnail(sheet[40 : sheet.shape[0] // 2, : sheet.shape[1] // 4])
    assert np.allclose(shown[..., :1], shown, atol=0.01)  # the photograph is grey
    assert sheet.std() > 0.1


def test_silhouettes_are_drawn_over_the_photograph_and_all_views_below(reconstruction, tmp_path):
    inside = torch.zeros(3, 40, 60)
    inside[:, 10:30, 20:40] = 1.0
    reliable = torch.tensor([True, False, True])
    silhouettes = Silhouettes(inside=inside, reliable=reliable, source="found")
    outlined = reconstruction.replace(silhouettes=silhouettes)
    shown = panels(outlined, 60)[0]
    assert shown.inside.shape == shown.picture.shape[:2]
    assert 0 < shown.inside.mean() < 1
    draw_overview(outlined, tmp_path / "outlined.png", 60)
    draw_overview(reconstruction, tmp_path / "bare.png", 60)
    with Image.open(tmp_path / "outlined.png") as tall, Image.open(tmp_path / "bare.png") as low:
        assert tall.size[0] == low.size[0]
        assert tall.size[1] > low.size[1] + 100
        below = np.asarray(tall.convert("RGB"))[low.size[1] :].astype(int)
    red = (below[..., 0] > 200) & (below[..., 1:] < 90).all(-1)
    yellow = (below[..., 0] > 200) & (below[..., 1] > 170) & (below[..., 2] < 130)
    assert red.sum() > 100
    assert yellow.sum() > 1.5 * red.sum()  # two views are trusted, one is not


def test_a_silhouette_without_border_is_not_drawn(reconstruction, tmp_path):
    silhouettes = Silhouettes(
        inside=torch.ones(3, 40, 60), reliable=torch.ones(3, dtype=torch.bool), source="masks"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_overview(
            reconstruction.replace(silhouettes=silhouettes), tmp_path / "overview.png", 60
        )


def test_names_that_the_font_has_no_glyphs_for_are_no_reason_to_warn(reconstruction, tmp_path):
    scene = reconstruction.scene
    named = scene.replace(views=scene.views.replace(names=("\u672c.png", "\u5929.png", "c.png")))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_overview(reconstruction.replace(scene=named), tmp_path / "overview.png", 60)


def test_gradients_do_not_hinder_drawing(reconstruction, tmp_path):
    vertices = reconstruction.mesh.vertices_world.clone().requires_grad_()
    mesh = reconstruction.mesh.replace(vertices_world=vertices)
    draw_overview(reconstruction.replace(mesh=mesh), tmp_path / "overview.png", 60)
    draw_overview(reconstruction, tmp_path / "without.png", 60)
    assert np.array_equal(drawn(tmp_path / "overview.png"), drawn(tmp_path / "without.png"))


def test_the_headline_counts(reconstruction):
    assert headline(reconstruction) == "3 of 4 photographs, 2 facets, 225 vertices, 2 s"
    doubted = reconstruction.replace(scene=reconstruction.scene.replace(doubt="All is flat."))
    assert headline(doubted).startswith("3 of 4 photographs (cameras doubtful), 2 facets")


def test_panels_lie_on_the_sheet_without_touching():
    shapes = [(90, 30), (20, 60), (40, 40), (50, 40), (30, 90)]
    shown = [Panel(title="", picture=np.zeros((*shape, 3), np.float32)) for shape in shapes]
    boxes, _ = _boxes(shown)
    assert len(boxes) == 5
    for left, bottom, width, height in boxes:
        assert 0 <= left < left + width <= 1
        assert 0 <= bottom < bottom + height <= 1
    rows = {bottom: bottom + height for _, bottom, _, height in boxes}
    (lower, lower_top), (upper, _) = sorted(rows.items())
    assert lower_top < upper
    assert lower >= 0
    columns = sorted((left, left + width) for left, _, width, _ in boxes[:4])
    assert all(right < left for (_, right), (left, _) in itertools.pairwise(columns))
