import torch

from pimper_torch.paper.cloud_filters import facets_under
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.paper.triangulate import Triangulate


def test_the_coarse_mesh_carries_what_is_known_of_its_points(dome_cloud):
    coarse = Triangulate(TriangulateConfig(num_points=60))(dome_cloud)
    assert coarse.covariance_world is not None
    assert coarse.covariance_world.shape == (len(coarse.mesh.vertices_world), 3, 3)
    assert (coarse.covariance_world[~coarse.is_point] == 0).all()
    points = coarse.points
    assert points is not None
    assert len(points.facet) > 100
    assert int(points.facet.max()) < len(coarse.mesh.faces)
    # No vertex among them, and each lies on its facet: near its plane on so round a mesh.
    gaps = torch.cdist(points.points_world, coarse.mesh.vertices_world[coarse.is_point])
    assert gaps.min() > 0
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[points.facet]]
    away = (points.points_world[:, None] - corners).norm(dim=-1).amax(dim=1)
    longest = (corners - corners.roll(1, dims=1)).norm(dim=-1).amax(dim=1)
    assert (away < 1.1 * longest).all()


def test_facets_under_points_of_an_image():
    corners = torch.tensor([[[0.0, 0], [2, 0], [0, 2]], [[2, 0], [2, 2], [0, 2]]])
    pixels = torch.tensor([[0.5, 0.5], [1.7, 1.7], [3.0, 1.0], [0.1, 1.0]])
    assert facets_under(pixels, corners).tolist() == [0, 1, -1, 0]
