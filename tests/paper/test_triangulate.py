import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.geometry.topology import half_edges
from pimper_torch.paper.cloud_filters import delaunay, fill_pixels, interpolate_inverse_depth
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.paper.triangulate import Triangulate, largest_component, peel
from pimper_torch.runtime.errors import ReconstructionError


def test_the_mesh_of_a_ball_faces_out_is_connected_and_lies_on_the_ball(dome_cloud):
    coarse = Triangulate(TriangulateConfig(num_points=120))(dome_cloud)
    vertices, faces = coarse.mesh.vertices_world, coarse.mesh.faces
    assert 80 <= len(vertices) <= 260
    outward = (face_normals(vertices, faces) * vertices[faces].mean(dim=1)).sum(dim=-1)
    assert (outward > 0).all()
    assert len(largest_component(faces)) == len(faces)
    # Exact points and a spline through them: 1 % of the radius is far more than its error.
    assert (vertices.norm(dim=-1) - 1).abs().max() < 0.01
    assert coarse.mesh.normals_world is not None
    cosine = (coarse.mesh.normals_world * vertices).sum(dim=-1)
    assert torch.rad2deg(cosine.clamp(-1, 1).acos()).mean() < 8


def test_the_mesh_has_no_hole(dome_cloud):
    faces = Triangulate()(dome_cloud).mesh.faces
    edges = half_edges(faces).sort(dim=1).values
    unique, counts = torch.unique(edges, dim=0, return_counts=True)
    euler = len(torch.unique(faces)) - len(unique) + len(faces)
    assert counts.max() == 2
    assert euler == 1  # a disc


def test_regions_without_points_are_filled_smoothly(dome_cloud):
    cap = dome_cloud.points_world[:, :2].norm(dim=1) < 0.45
    kept = (~cap).nonzero()[:, 0]
    place = torch.full((len(cap),), -1).scatter(0, kept, torch.arange(len(kept)))
    seen = ~cap[dome_cloud.observation_point]
    bald = dome_cloud.replace(
        points_world=dome_cloud.points_world[kept],
        reprojection_errors_px=dome_cloud.reprojection_errors_px[kept],
        observation_point=place[dome_cloud.observation_point[seen]],
        observation_view=dome_cloud.observation_view[seen],
        observation_pixels=dome_cloud.observation_pixels[seen],
    )
    filled = Triangulate()(bald)
    flat = Triangulate(TriangulateConfig(fill=False))(bald)
    assert filled.is_point.logical_not().sum() > 10
    assert flat.is_point.all()
    new = filled.mesh.vertices_world[~filled.is_point]
    # A flat surface over the bald cap would lie 1 - sqrt(1 - 0.45^2) = 0.107 under its top.
    assert (new.norm(dim=-1) - 1).abs().max() < 0.03
    centre = flat.mesh.vertices_world[flat.mesh.faces].mean(dim=1).norm(dim=-1)
    assert centre.min() < 0.92


def test_outliers_do_not_become_vertices(dome_cloud):
    generator = torch.Generator().manual_seed(5)
    moved = dome_cloud.points_world.clone()
    moved[::15] *= 1 + 0.4 * torch.rand(len(moved[::15]), 1, generator=generator)
    coarse = Triangulate()(dome_cloud.replace(points_world=moved))
    assert (coarse.mesh.vertices_world.norm(dim=-1) - 1).abs().max() < 0.05


def test_what_shows_no_object_is_peeled_off_the_rim(dome_cloud):
    coarse = Triangulate()(dome_cloud)
    masks = dome_cloud.views.inside.clone()
    masks[..., :80] = False  # the left half of every photograph
    masked = dome_cloud.replace(views=dome_cloud.views.replace(masks=masks))
    peeled = Triangulate()(masked)
    centers = peeled.mesh.vertices_world[peeled.mesh.faces].mean(dim=1)
    view = peeled.reference
    pixels, _ = project(
        centers, masked.cameras.cam_from_world[view], masked.cameras.intrinsics[view]
    )
    assert pixels[:, 0].min() > 70
    assert len(peeled.mesh.faces) < 0.75 * len(coarse.mesh.faces)


def test_peeling_opens_no_hole():
    # A fan: six triangles round a vertex; the unwanted one in a closed ring stays.
    grid = torch.tensor([[u, v] for v in range(5) for u in range(5)], dtype=torch.float64)
    faces = delaunay(grid + 0.01 * torch.sin(7 * grid.flip(1)))
    centers = grid[faces].mean(dim=1)
    inner = (centers - 2).abs().amax(dim=1) < 0.7
    assert len(peel(faces, inner)) == len(faces)
    outer = centers[:, 0] < 1
    assert len(peel(faces, outer)) < len(faces)


def test_spikes_are_dropped_and_blunt_ears_stay():
    square = torch.tensor([[0, 1, 2], [0, 2, 3]])
    ear = torch.tensor([[2, 1, 4]])  # its tip is corner 2 of the face
    both = torch.cat([square, ear])
    tip = torch.zeros_like(both, dtype=torch.bool)
    tip[2, 2] = True
    assert peel(both, torch.zeros(3, dtype=torch.bool), tip).tolist() == square.tolist()
    base = torch.zeros_like(tip)
    base[2, 0] = True  # sharp at a corner that has a neighbour
    assert len(peel(both, torch.zeros(3, dtype=torch.bool), base)) == 3


def test_bridges_over_a_depth_discontinuity_are_dropped(dome_cloud):
    step = dome_cloud.points_world.clone()
    # Flatten the ball to two levels with a cliff at x = 0 that no facet may span.
    step[:, 2] = torch.where(step[:, 0] < 0, 0.0, 1.0)
    config = TriangulateConfig(fill=False)
    flat = dome_cloud.replace(
        points_world=step, reprojection_errors_px=torch.zeros_like(step[:, 0])
    )
    coarse = Triangulate(config)(flat)
    levels = coarse.mesh.vertices_world[coarse.mesh.faces][..., 2]
    assert (levels.amax(dim=1) - levels.amin(dim=1) < 0.5).all()


def test_inverse_depth_of_a_plane_is_reproduced_exactly():
    generator = torch.Generator().manual_seed(6)
    known = 300 * torch.rand(80, 2, generator=generator, dtype=torch.float64)
    wanted = 300 * torch.rand(20, 2, generator=generator, dtype=torch.float64)
    slope = torch.tensor([1e-4, -2e-4], dtype=torch.float64)
    found = interpolate_inverse_depth(known, 0.2 + known @ slope, wanted, smoothing=0.0)
    assert_close(found, 0.2 + wanted @ slope, atol=1e-9, rtol=0)


def test_filled_pixels_keep_away_from_points_and_inside_the_faces():
    known = torch.tensor([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [100.0, 100.0]]).double()
    faces = delaunay(known)
    all_filled = fill_pixels(known, faces, 12.0)
    half = fill_pixels(known, faces[:1], 12.0)
    assert torch.cdist(all_filled, known).min() > 0.8 * 12
    assert 0.4 < len(half) / len(all_filled) < 0.6


def test_a_cloud_without_trustworthy_points_is_refused_with_counts(dome_cloud):
    bad = dome_cloud.replace(reprojection_errors_px=100 + 0 * dome_cloud.reprojection_errors_px)
    with pytest.raises(ReconstructionError, match=r"0 of \d+ sparse points .* 0 reprojected"):
        Triangulate()(bad)
