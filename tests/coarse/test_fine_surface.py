import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import face_components, face_pairs
from pimper_torch.records import Support
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.memory import release_memory
from pimper_torch.stages.coarse import oriented, trim
from pimper_torch.stages.coarse.densify import depth_maps
from pimper_torch.stages.coarse.fine_surface import closed_surface, cropped
from pimper_torch.stages.coarse.oriented import no_points
from pimper_torch.stages.coarse.surface import CoarseSurface
from pimper_torch.stages.coarse.trim import ViewCounts, seen_surface
from pimper_torch.stages.silhouettes.trace import TraceContours
from tests.coarse.ball import SETTINGS, mottled, photographed, silhouettes_of


def counted(faces, behind=0):
    """Return counts of three views that see each face, and of those that see through it."""
    seen = torch.full((faces,), 3)
    return ViewCounts(seen=seen, lit=seen, behind=behind + 0 * seen)


@pytest.fixture
def small_holes(monkeypatch):
    """Close holes up to an area of 0.3 with pixels of 1."""
    monkeypatch.setattr(trim, "HOLE_PX", 0.3**0.5)


def white(points):
    return torch.full_like(points, 0.7)


def half_mottled(points):
    """Return waves above the equator and a constant colour below."""
    return torch.where(points[..., 2:] > 0, mottled(points), 0.7)


def built(scene, some=lambda points: points[:, 2] > -2):
    """Return the coarse mesh of a ball with silhouettes, from part of its cloud."""
    errors = torch.where(some(scene.points_world), 0.5, 100.0)
    scene = scene.replace(reprojection_errors_px=errors.to(scene.reprojection_errors_px))
    return CoarseSurface(SETTINGS)(
        scene, TraceContours()(silhouettes_of(scene.cameras), scene.cameras)
    )


def is_closed(mesh):
    pairs, _ = face_pairs(mesh.faces)
    return 2 * len(pairs) == 3 * len(mesh.faces) and int(face_components(mesh.faces).max()) == 0


def test_a_half_textured_ball_is_closed_and_its_support_recorded(round_about):
    scene = photographed(round_about.cameras.to(torch.float64), half_mottled)
    coarse = built(scene, lambda points: points[:, 2] > 0)
    mesh = coarse.mesh
    assert is_closed(mesh)
    centre = mesh.vertices_world[mesh.faces].mean(dim=1)
    off = (centre.norm(dim=1) - 1).abs()
    # A pixel is 0.022 of the radius there.
    assert off.mean() < 0.02
    assert off.max() < 0.1
    above, below = centre[:, 2] > 0.2, centre[:, 2] < -0.2
    # Views 40 degrees apart match part of it.
    assert (coarse.support[above] == Support.POINTS).float().mean() > 0.15
    assert (coarse.support[below] == Support.POINTS).float().mean() < 0.02
    assert (coarse.support[below] == Support.CONTOUR).float().mean() > 0.3
    assert (coarse.support >= Support.LIGHT).float().mean() > 0.8


def test_photographs_are_matched_once_for_a_second_surface_with_more_points(
    round_about, monkeypatch
):
    scene = photographed(round_about.cameras.to(torch.float64), mottled)
    contours = TraceContours()(silhouettes_of(scene.cameras), scene.cameras)
    more = no_points(scene.points_world)
    calls = []

    def counted_maps(*given):
        calls.append(given)
        return depth_maps(*given)

    monkeypatch.setattr(oriented, "depth_maps", counted_maps)
    first = CoarseSurface(SETTINGS)(scene, contours)
    again = CoarseSurface(SETTINGS)(scene, contours, None, more)
    assert len(calls) == 1
    assert torch.equal(first.mesh.vertices_world, again.mesh.vertices_world)
    darker = scene.replace(views=scene.views.replace(images=scene.views.images / 2))
    CoarseSurface(SETTINGS)(darker, contours, None, more)
    assert len(calls) == 2
    release_memory()
    CoarseSurface(SETTINGS)(darker, contours, None, more)
    assert len(calls) == 3


def test_an_untextured_ball_follows_from_its_silhouettes(round_about):
    scene = photographed(round_about.cameras.to(torch.float64), white)
    coarse = built(scene, lambda points: points[:, 2] > 2)
    assert is_closed(coarse.mesh)
    assert len(coarse.points.facet) == 0
    assert not bool((coarse.support == Support.POINTS).any())
    assert (coarse.mesh.vertices_world.norm(dim=1) - 1).abs().mean() < 0.03
    outward = normalize(face_normals(coarse.mesh.vertices_world, coarse.mesh.faces), dim=-1)
    towards = normalize(coarse.mesh.vertices_world[coarse.mesh.faces].mean(dim=1), dim=-1)
    assert ((outward * towards).sum(dim=-1) > 0.6).float().mean() > 0.98


def test_unseen_surface_is_excluded():
    cameras = arc_cameras(6, width=120, height=100, focal_px=180.0, distance=4.0, sway_deg=4.0)
    mesh = built(photographed(cameras)).mesh
    # The hull extends to -2.2; views 25 degrees off the centre see to -0.2, and Poisson
    # extrapolates beyond the last contours by a few facets.
    assert -0.75 < float(mesh.vertices_world[:, 2].min()) < 0.1
    off = (mesh.vertices_world.norm(dim=1) - 1).abs()
    assert off.max() < 0.2
    assert off[mesh.vertices_world[:, 2] > 0].mean() < 0.02


def test_surface_that_views_see_through_is_dropped_except_small_dents(small_holes):
    vertices, faces = icosphere(3)
    centre = vertices[faces].mean(dim=1)
    cover, speck = centre[:, 2] > 0.8, centre[:, 2] < -0.97
    counts = counted(len(faces), behind=torch.where(cover | speck, 2, 0))
    support = torch.full_like(counts.seen, Support.LIGHT)
    support[centre[:, 0] > 0.9] = Support.CONTOUR
    everywhere = torch.ones_like(cover)
    kept = seen_surface(vertices, faces, support, counts, everywhere, 1.0, 0.01)
    assert bool((kept == ~cover).all())  # the cover's area is 1.2, the speck's 0.2
    # Surface with points is never dropped.
    support[cover] = Support.POINTS
    assert bool(seen_surface(vertices, faces, support, counts, everywhere, 1.0, 0.01).all())


def test_the_unseen_bottom_of_a_concavity_is_kept_and_the_back_dropped(monkeypatch):
    vertices, faces = icosphere(3)
    centre = vertices[faces].mean(dim=1)
    bottom, back, cover = centre[:, 2] > 0.97, centre[:, 2] < -0.5, centre[:, 0] > 0.97
    assert 0.005 < bottom.double().mean() < 0.02 < back.double().mean()
    count = torch.full((len(faces),), 3)
    seen = torch.where(bottom | back | cover, 0, count)
    counts = ViewCounts(seen=seen, lit=seen, behind=torch.where(cover, 2, 0))
    support = torch.where(seen > 0, Support.POINTS, Support.NOTHING)
    everywhere = torch.ones_like(cover)
    monkeypatch.setattr(trim, "HOLE_PX", 0.0)

    def kept(inside=everywhere):
        return seen_surface(vertices, faces, support, counts, inside, 1.0, 0.01)

    assert bool((kept() == ~(back | cover)).all())
    # One face that is seen through or is outside the hull removes the entire bottom.
    assert bool((kept(inside=everywhere & (centre[:, 2] < centre[:, 2].max())) == (seen > 0)).all())
    monkeypatch.setattr(trim, "MAX_UNSEEN", 0.0)
    assert bool((kept() == (seen > 0)).all())


def test_components_without_points_and_contours_are_dropped():
    vertices, faces = icosphere(2)
    two = torch.cat([vertices, 0.3 * vertices + 3]), torch.cat([faces, faces + len(vertices)])
    first = torch.arange(len(two[1])) < len(faces)
    counts = counted(len(two[1]))
    support = torch.where(first, Support.POINTS, Support.LIGHT)
    kept = seen_surface(*two, support, counts, torch.ones_like(first), 1.0, 0.01)
    assert bool((kept == first).all())
    support = torch.where(first, Support.POINTS, Support.CONTOUR)
    shape = *two, support, counts, torch.ones_like(first), 1.0, 0.01
    assert bool(seen_surface(*shape).all())
    assert bool((seen_surface(*shape, Support.POINTS) == first).all())


@pytest.mark.parametrize(("share", "stays"), [(0.3, False), (0.2, True)])
def test_a_floating_component_is_dropped_if_views_see_through_enough(small_holes, share, stays):
    vertices, faces = icosphere(2)
    two = torch.cat([vertices, 0.9 * vertices + 3]), torch.cat([faces, faces + len(vertices)])
    index = torch.arange(len(two[1]))
    first, through = index < len(faces), index >= (2 - share) * len(faces)
    support = torch.where(first, Support.POINTS, Support.CONTOUR)

    def kept(behind):
        counts = counted(len(index), behind=2 * behind.long())
        return seen_surface(*two, support, counts, torch.ones_like(first), 1.0, 0.01)

    assert bool((kept(through) == (first | (~through & stays))).all())
    assert bool(kept(first).all())  # depth maps behind points are wrong


def test_cropped_views_show_the_same_pixels_at_projected_points(round_about):
    silhouettes = silhouettes_of(round_about.cameras)
    part = cropped(round_about, silhouettes)
    assert part.views.images.shape[-1] < round_about.views.images.shape[-1]
    points = round_about.points_world
    for view in (0, 5):
        before, after = (
            project(points, one.cameras.cam_from_world[view], one.cameras.intrinsics[view])[0]
            for one in (round_about, part)
        )
        u, v = before.long().unbind(dim=1)
        x, y = after.floor().long().unbind(dim=1)
        shown = silhouettes.masks[view, v, u]
        assert shown.sum() > 100
        assert bool(part.views.masks[view, y, x][shown].all())
        images, parts = round_about.views.images[view], part.views.images[view]
        assert_close(parts[:, y[shown], x[shown]], images[:, v[shown], u[shown]])


def test_a_view_without_silhouette_is_masked_entirely(round_about):
    silhouettes = silhouettes_of(round_about.cameras)
    inside = silhouettes.inside.clone()
    inside[3] = 0
    part = cropped(round_about, silhouettes.replace(inside=inside))
    assert not bool(part.views.masks[3].any())
    assert bool(part.views.masks[2].any())


def test_too_few_points_and_contours_are_rejected(round_about):
    contours = TraceContours()(silhouettes_of(round_about.cameras), round_about.cameras)
    contours = contours.replace(rays=contours.rays.take(torch.arange(5)))
    with pytest.raises(ReconstructionError, match="0 points were matched inside the silhouettes"):
        closed_surface(no_points(round_about.points_world), contours, 0.02)
