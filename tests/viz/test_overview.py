import itertools
import warnings

import numpy as np
import torch
from PIL import Image

from pimper_torch.records import Silhouettes
from pimper_torch.viz.overview import Panel, _boxes, draw_overview, headline, panels


def test_the_sheet_is_drawn(reconstruction, tmp_path):
    draw_overview(reconstruction, tmp_path / "overview.png", 120)
    with Image.open(tmp_path / "overview.png") as picture:
        assert picture.size[0] == 1600
        assert np.asarray(picture.convert("RGB")).std() > 20  # something is on it


def test_every_panel_shows_the_object_of_the_reference_view(reconstruction):
    shown = panels(reconstruction, 120)
    assert len(shown) == 8
    assert "b.png" in shown[0].title
    for panel in shown:
        assert panel.picture.shape[2] == 3
        assert 0 <= panel.picture.min() < panel.picture.max() <= 1
    photograph, facets = shown[0].picture, shown[1]
    assert np.array_equal(facets.picture, np.float32(0.45) * photograph)
    assert facets.lines.shape == (2, 3, 2)
    height, width = photograph.shape[:2]
    assert (facets.lines >= -0.5).all()
    assert (facets.lines[..., 0] <= width + 0.5).all()
    assert (facets.lines[..., 1] <= height + 0.5).all()


def test_a_grey_result_without_normals_and_albedo_is_drawn_too(reconstruction, tmp_path):
    views = reconstruction.scene.views
    grey = reconstruction.scene.replace(views=views.replace(images=views.images[:, :1]))
    bare = reconstruction.mesh.replace(normals_world=None, albedo=None, confidence=None)
    draw_overview(reconstruction.replace(scene=grey, mesh=bare), tmp_path / "overview.png", 60)
    assert (tmp_path / "overview.png").stat().st_size > 10_000


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


def test_an_silhouette_without_border_is_not_drawn(reconstruction, tmp_path):
    """Matplotlib would warn of a contour that is not there."""
    silhouettes = Silhouettes(
        inside=torch.ones(3, 40, 60), reliable=torch.ones(3, dtype=torch.bool), source="masks"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_overview(
            reconstruction.replace(silhouettes=silhouettes), tmp_path / "overview.png", 60
        )


def test_gradients_do_not_hinder_drawing(reconstruction, tmp_path):
    vertices = reconstruction.mesh.vertices_world.clone().requires_grad_()
    mesh = reconstruction.mesh.replace(vertices_world=vertices)
    draw_overview(reconstruction.replace(mesh=mesh), tmp_path / "overview.png", 60)
    assert (tmp_path / "overview.png").is_file()


def test_the_headline_counts(reconstruction):
    assert headline(reconstruction) == "3 of 4 photographs, 2 facets, 225 vertices, 2 s"


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
