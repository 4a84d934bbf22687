from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from pimper_bench.metrics import align_estimate, trimmed_icp
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.similarity import rotation_angles_deg, split_similarity
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError

FEW = {"count": 800}


def fitted(*given, **settings):
    found, residual, converged = trimmed_icp(*given, **settings)
    return SimpleNamespace(truth_from_world=found, residual=residual, converged=converged)


def known_similarity(make, generator, angle_deg=6.0, scale=1.07):
    shift = 0.08 * torch.randn(3, generator=generator, dtype=torch.float64)
    return rigid(scale * make.rotation(generator, angle_deg), shift)


def with_outliers(mesh, generator, fraction):
    """Add triangles off the surface until they have this fraction of the area."""
    a, b, c = mesh.vertices_world[mesh.faces].unbind(dim=1)
    area = float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2)
    count = 40
    side = (2 * area * fraction / (1 - fraction) / count) ** 0.5
    corner = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    corner = 2.2 * torch.nn.functional.normalize(corner, dim=1)
    frame = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator).double()).Q
    triangles = torch.stack(
        [corner, corner + side * frame[:, 0], corner + side * frame[:, 1]], dim=1
    )
    start = len(mesh.vertices_world)
    return Mesh(
        vertices_world=torch.cat([mesh.vertices_world, triangles.reshape(-1, 3)]),
        faces=torch.cat([mesh.faces, start + torch.arange(3 * count).reshape(-1, 3)]),
    )


def error_of(found, known):
    """Return scale, angle and shift of the residual of a similarity and its estimate."""
    left = found @ torch.linalg.inv(known)
    scale, rotation = split_similarity(left)
    return abs(scale - 1), float(rotation_angles_deg(rotation)), float(left[:3, 3].norm())


def test_a_known_similarity_is_found_among_a_third_of_outliers(generator, make):
    truth = make.potato(level=3)
    known = known_similarity(make, generator)
    dirty = with_outliers(truth, generator, fraction=0.3)
    estimate = make.moved(dirty, torch.linalg.inv(known))
    settings = {"trimmed_fraction": 0.35, "iterations": 150, "count": 600}
    found = fitted(estimate, truth, torch.eye(4).double(), generator=generator, **settings)
    scale, angle, shift = error_of(found.truth_from_world, known)
    # More than the outliers is trimmed, so the rest is exactly on the truth.
    assert scale < 1e-6
    assert angle < 6e-5
    assert shift < 1e-6


def test_an_enlarged_sphere_is_scaled_and_not_rotated(generator, make):
    truth = make.sphere(level=4)
    settings = dict(trimmed_fraction=0.0, **FEW)
    start = torch.eye(4).double()
    found = fitted(make.sphere(1.2, level=4), truth, start, generator=generator, **settings)
    scale, rotation = split_similarity(found.truth_from_world)
    assert scale == pytest.approx(1 / 1.2, rel=1e-3)  # both have facets
    # The rotation of a sphere is undetermined; facets must not induce one.
    assert float(rotation_angles_deg(rotation)) < 3


def test_a_plane_does_not_slide_or_grow_beyond_the_limits(generator, make):
    start = rigid(torch.eye(3), torch.tensor([0.3, 0.2, 0.1])).double()
    settings = dict(trimmed_fraction=0.0, **FEW)
    found = fitted(make.square(), make.square(side=4.0), start, generator=generator, **settings)
    expected = rigid(torch.eye(3), torch.tensor([0.3, 0.2, 0.0])).double()
    assert_close(found.truth_from_world, expected, atol=1e-9, rtol=0)


def test_a_cloud_is_measured_by_points(generator, make):
    truth = make.potato(level=4)
    cloud = truth.replace(faces=truth.faces[:0])
    known = known_similarity(make, generator, angle_deg=2.0, scale=1.01)
    estimate = make.moved(truth, torch.linalg.inv(known))
    settings = dict(trimmed_fraction=0.1, **FEW)
    found = fitted(estimate, cloud, torch.eye(4).double(), generator=generator, **settings)
    assert error_of(found.truth_from_world, known)[0] < 0.01


def aligned(make, generator, method, cameras_there=True):
    """Transform a potato and five cameras by a known similarity, and align them."""
    truth, cameras = make.potato(level=2), make.cameras()
    rotation = make.rotation(generator, 50.0)
    shift = torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64)
    world_from_truth = rigid(0.5 * rotation, shift)
    estimate = Estimate(
        mesh=make.moved(truth, world_from_truth),
        names=tuple(f"view_{index}.jpg" for index in range(5)) if cameras_there else (),
        cameras=make.transferred(cameras, 0.5, rotation, shift) if cameras_there else None,
    )
    capture = make.capture_of(truth, cameras=cameras)
    found = align_estimate(estimate, capture, method, generator=generator)
    return found, torch.linalg.inv(world_from_truth)


@pytest.mark.parametrize("method", ["auto", "cameras", "icp"])
def test_cameras_with_equal_names_align_the_frames(generator, make, method):
    found, truth_from_world = aligned(make, generator, method)
    assert_close(found.truth_from_world, truth_from_world, atol=1e-6, rtol=0)
    assert found.method == ("icp" if method == "icp" else "cameras")
    assert found.cameras == 5
    assert found.scale == pytest.approx(2.0)
    assert found.rotation_deg == pytest.approx(50.0)
    assert found.trimmed_fraction == (0.2 if method == "icp" else None)


def test_without_cameras_frames_are_not_aligned_with_a_message(generator, make):
    found, _ = aligned(make, generator, "auto", cameras_there=False)
    assert found.method == "none"
    assert torch.equal(found.truth_from_world, torch.eye(4).double())
    with pytest.raises(InputError, match="0 views have a camera in both"):
        aligned(make, generator, "cameras", cameras_there=False)


@pytest.mark.parametrize("angle_deg", [1e-7, 30.0, 179.9999])
def test_angles_of_rotations_are_accurate_at_both_ends(generator, make, angle_deg):
    found = rotation_angles_deg(make.rotation(generator, angle_deg))
    assert float(found) == pytest.approx(angle_deg, rel=1e-8)
