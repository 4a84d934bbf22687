"""Results in a different unit: all lengths change, and only these."""

import dataclasses
import typing

import pytest
import torch
from jaxtyping import AbstractArray
from probes import small_scene
from torch.utils import _pytree as pytree

import pimper_torch as pt
from pimper_torch.geometry.projection import project
from pimper_torch.records import Depths, FacetPoints, Heights
from pimper_torch.scale.scaled import LAST, POSES, POWERS

# Fields without a unit of length: pixels, angles, radiance, fractions.
WITHOUT = {
    "Views": {"images", "focals_px"},
    "Cameras": {"intrinsics"},
    "SparseScene": {"reprojection_errors_px", "observation_pixels", "background_from_view"},
    "Silhouettes": {"inside", "expected_overlap"},
    "Mesh": {"normals_world", "albedo", "confidence"},
    "Templates": {"barycentric", "normals_patch"},
    "Photometry": {"normals_patch", "albedo", "lights_patch", "information", "exposure"},
    "PatchPriors": {
        *("normals_patch", "normal_information", "albedo", "albedo_variance"),
        *("inlier", "lights_patch", "light_variance"),
    },
    "NormalPrior": {"normals", "variance"},
    "AlbedoPrior": {"albedo", "variance"},
    "InlierPrior": {"probability"},
    "SilhouettePrior": {"inside"},
    "LightPrior": {"lights", "variance"},
    "Surface": {"barycentric", "normals_world", "albedo", "information"},
    "Convergence": {"residual"},
    "ViewLights": {"direction_world", "inverse_distance", "ambient", "directed"},  # a ratio
    "Materials": {"metallic", "roughness", "specular"},
    "ViewErrors": {"psnr_db"},
    "TexturedMesh": {"normals", "uv", "tangent", "base_color", "normal", "reflectance"},
}


def parts_of(hint):
    yield hint
    for part in typing.get_args(hint):
        yield from parts_of(part)


def records_in(kind, found):
    """Collect the records inside a record, in any container."""
    if kind not in found:
        found.add(kind)
        for hint in typing.get_type_hints(kind).values():
            for part in parts_of(hint):
                if isinstance(part, type) and issubclass(part, pt.Record):
                    records_in(part, found)
    return found


def test_every_number_of_a_result_is_declared_a_length_or_not():
    kinds = records_in(pt.Reconstruction, {pt.Surface})
    assert {Heights, Depths, pt.CoarseMesh, FacetPoints} <= kinds
    for kind in kinds:
        known = {
            *POWERS.get(kind, {}),
            POSES.get(kind),
            LAST.get(kind),
            *WITHOUT.get(kind.__name__, ()),
        }
        hints = typing.get_type_hints(kind)
        for field in dataclasses.fields(kind):
            for part in parts_of(hints[field.name]):
                if isinstance(part, type) and issubclass(part, AbstractArray):
                    real = any(dtype.startswith("float") for dtype in part.dtypes)
                    assert not real or field.name in known, f"{kind.__name__}.{field.name}"


def alike(first, second, tolerance):
    """Compare the tensors of two records."""
    ones, others = (pytree.tree_leaves(record) for record in (first, second))
    assert len(ones) == len(others) > 20
    for one, other in zip(ones, others, strict=True):
        if isinstance(one, torch.Tensor):
            torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance, equal_nan=True)


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
def test_a_scene_in_a_different_unit_gives_the_result_in_that_unit():
    """A length that is not scaled, or a setting in scene units, would be off by a factor."""
    scene, coarse = (record.to(torch.float32) for record in small_scene(num_views=5, width=40))
    settings = {"silhouettes": {"object": "everything"}, "scales": [1.0]}
    chain = pt.load_chain("default", settings)
    plain = chain(scene, mesh=coarse.mesh)
    large = chain(pt.scaled(scene, 4.0), mesh=pt.scaled(coarse.mesh, 4.0))
    wanted = pt.scaled(plain, 4.0)
    assert large.mesh.vertices_world.abs().max() > 3.9  # of a ball of radius 1, times 4
    rest = {"report": (), "failures": ()}
    alike(large.replace(**rest), wanted.replace(**rest), 1e-4)  # a power of two causes no rounding


def test_scaling_back_gives_the_same(reconstruction):
    there = pt.scaled(reconstruction, 25.4)
    was = reconstruction.mesh.vertices_world
    torch.testing.assert_close(there.mesh.vertices_world, 25.4 * was)
    alike(pt.scaled(there, 1 / 25.4), reconstruction, 1e-6)
    assert pt.scaled(reconstruction, 1.0) is reconstruction


def test_scaling_shares_photographs_and_keeps_object_identity(reconstruction):
    made = pt.scaled(reconstruction, 3.0)
    assert made.scene.views is reconstruction.scene.views
    assert made.patches.patches.coarse is made.coarse
    assert made.coarse is not reconstruction.coarse


def test_a_scaled_scene_has_the_same_images(reconstruction):
    far = reconstruction.scene.replace(offset_world=(10.0, 20.0, -30.0))
    made = pt.scaled(reconstruction.replace(scene=far), 7.0)
    assert made.scene.offset_world == (70.0, 140.0, -210.0)
    before, after = (
        project(found.mesh.vertices_world, found.cameras.cam_from_world, found.cameras.intrinsics)
        for found in (reconstruction, made)
    )
    torch.testing.assert_close(after[0], before[0], rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(after[1], 7 * before[1])


def test_variances_and_planes_are_scaled_by_their_dimension():
    points = FacetPoints(
        points_world=torch.ones(1, 3),
        covariance_world=torch.eye(3)[None],
        facet=torch.zeros(1, dtype=torch.long),
    )
    assert torch.equal(pt.scaled(points, 3.0).covariance_world, 9 * points.covariance_world)
    ones = torch.ones(1, 1, 1)
    heights = Heights(offset=ones, information=ones, num_views=torch.ones(1).long())
    assert float(pt.scaled(heights, 2.0).information) == 0.25
    silhouettes = pt.Silhouettes(
        inside=ones,
        reliable=torch.zeros(1, dtype=torch.bool),
        source="everything",
        planes_world=torch.tensor([[0.0, 1.0, 0.0, -2.0]]),
    )
    on = torch.tensor([5.0, 2.0, 1.0])
    plane = pt.scaled(silhouettes, 10.0).planes_world[0]
    assert float(plane[:3] @ (10 * on) + plane[3]) == 0


def test_lengths_in_reports_are_scaled_and_counts_are_not(reconstruction):
    report = reconstruction.report[0].replace(figures={"mismatch": 0.5, "samples": 96})
    made = pt.scaled(reconstruction.replace(report=(report,)), 4.0)
    assert made.report[0].figures == {"mismatch": 2.0, "samples": 96}


@pytest.mark.parametrize("factor", [0.0, -1.0, float("inf"), float("nan")])
def test_an_invalid_factor_is_refused(factor, reconstruction):
    with pytest.raises(pt.ConfigError, match=r"factor is .*above 0 and finite"):
        pt.scaled(reconstruction, factor)
