import torch
from torch.testing import assert_close

from pimper_bench.metrics.compared_page import errors_of
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.records import Mesh


def ball(radius=1.0, detail=4):
    vertices, faces = icosphere(detail)
    return Mesh(vertices_world=radius * vertices, faces=faces, normals_world=vertices)


def similarity(scale, shift):
    matrix = torch.eye(4).double()
    matrix[:3] *= scale
    matrix[:3, 3] = torch.tensor(shift)
    return matrix


def test_distances_are_in_units_of_the_truth_after_the_similarity():
    placed = similarity(2.0, [1.0, -2.0, 3.0])
    truth = ball(2.0, 5)
    truth = truth.replace(vertices_world=truth.vertices_world + torch.tensor([1.0, -2.0, 3.0]))
    errors = errors_of(ball(1.05), truth, placed)
    distance = errors["_DISTANCE_TO_TRUTH"]
    assert_close(distance, torch.full_like(distance, 0.1), atol=2e-3, rtol=0)
    assert errors["_NORMAL_ERROR_DEG"].max() < 2.0  # the true faces
    turned = ball().replace(normals_world=torch.tensor([[0.0, 0.0, 1.0]]).expand(2562, 3))
    angle = errors_of(turned, ball(1.0, 5), similarity(1.0, [0.0, 0.0, 0.0]))["_NORMAL_ERROR_DEG"]
    height = turned.vertices_world[:, 2].clamp(-1, 1)
    assert_close(angle, torch.rad2deg(height.arccos()).float(), atol=2.0, rtol=0)


def test_points_give_only_distances():
    points = Mesh(vertices_world=torch.zeros(1, 3), faces=torch.zeros(0, 3, dtype=torch.long))
    errors = errors_of(ball(), points, torch.eye(4).double())
    assert list(errors) == ["_DISTANCE_TO_TRUTH"]
    assert_close(errors["_DISTANCE_TO_TRUTH"], torch.ones(2562))
