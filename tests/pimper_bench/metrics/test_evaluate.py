import json

import pytest
import torch

from pimper_bench.metrics import EvaluateConfig, evaluate, report, rows
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.evaluation import chosen_views
from pimper_bench.truth import Truth
from pimper_torch.geometry.rigid import rigid
from pimper_torch.runtime.errors import InputError

FEW = {"samples": 3000}


@pytest.fixture
def parts(make, generator):
    """A sphere with cameras and lights, and its copy in a different frame at half the size."""
    truth, cameras = make.sphere(level=4), make.cameras()
    lights = torch.randn(5, 4, generator=generator, dtype=torch.float64)
    rotation = make.rotation(generator)
    shift = torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64)
    rotated = lights.clone()
    rotated[:, 1:] = lights[:, 1:] @ rotation.mT
    estimate = Estimate(
        mesh=make.moved(truth, rigid(0.5 * rotation, shift)).replace(
            normals_world=truth.vertices_world @ rotation.mT
        ),
        names=tuple(f"view_{index}.png" for index in (4, 2, 0)),
        cameras=make.transferred(cameras, 0.5, rotation, shift).take([4, 2, 0]),
        lights_world=rotated[[4, 2, 0]],
        reference="view_2.png",
    )
    return estimate, make.capture(Truth(mesh=truth, lights_world=lights), cameras=cameras)


def test_a_copy_in_a_different_frame_has_no_error(parts):
    found = evaluate(*parts, EvaluateConfig(**FEW))
    assert found.alignment.method == "cameras"
    assert found.alignment.scale == pytest.approx(2)
    assert found.surface.accuracy.mean < 1e-10
    assert found.surface.whole.completeness.mean < 1e-10
    assert found.surface.whole.thresholds[0].f_score == 1
    (view,) = found.views
    assert view.name == "view_2.png"
    assert view.relative_error < 1e-3
    assert view.transferred_normals.mean_deg < 0.5  # the true shape has facets
    assert view.shape_normals.mean_deg < 0.1
    assert found.lights.mean_deg < 1e-5
    assert found.lights.lights == 3
    assert found.cameras.missing == 2
    assert found.cameras.mean_center < 1e-9
    assert found.cameras.mean_center_percent == pytest.approx(0, abs=1e-6)
    assert found.dtu is None


def test_without_alignment_the_frames_are_used_unchanged(parts, make):
    estimate, capture = parts
    config = EvaluateConfig(alignment="none", **FEW)
    with pytest.raises(InputError, match=r"different frames.* common cameras"):
        evaluate(estimate, capture, config)
    shift = torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    near = estimate.replace(
        mesh=make.moved(capture.truth.mesh, rigid(torch.eye(3).double(), shift))
    )
    found = evaluate(near, capture.replace(cameras=None), config)
    assert found.alignment.method == "none"
    assert found.surface.accuracy.mean == pytest.approx(0.2, rel=0.05)  # mean of |0.4 cos|


def test_a_mesh_alone_is_evaluated_by_its_surface_and_the_centre_view(parts, make):
    _, capture = parts
    found = evaluate(Estimate(mesh=make.sphere(1.1, level=4)), capture, EvaluateConfig(**FEW))
    assert found.alignment.method == "none"
    assert found.surface.accuracy.mean == pytest.approx(0.1, rel=0.02)
    assert [view.name for view in found.views] == ["view_2.png"]
    assert found.lights is None
    assert found.cameras is None


def test_views_are_selected_by_name_with_any_suffix(parts):
    estimate, capture = parts
    config = EvaluateConfig(views=("view_4.jpg", "view_1.png", "view_4.png"))
    assert chosen_views(estimate, capture, config) == (4, 1)
    assert chosen_views(estimate.replace(reference="other.png"), capture, EvaluateConfig()) == (2,)
    with pytest.raises(InputError, match=r"no view 'nobody.png' in the truth; it has view_0.png"):
        chosen_views(estimate, capture, EvaluateConfig(views=("nobody.png",)))


def test_the_same_seed_gives_the_same_figures(parts):
    one, same, other = (
        report(evaluate(*parts, EvaluateConfig(alignment="icp", seed=seed, **FEW)))
        for seed in (3, 3, 4)
    )
    assert one == same
    assert one != other


def test_maps_of_a_few_views_may_be_given_separately(parts):
    estimate, capture = parts
    only = capture.replace(
        views=capture.views.take([2]),
        cameras=capture.cameras.take([2]),
        truth=Truth(mesh=capture.truth.mesh),
    )
    found = evaluate(estimate, capture, EvaluateConfig(**FEW), maps=only)
    assert [view.name for view in found.views] == ["view_2.png"]
    assert found.cameras.views == 5


def test_the_report_is_json_with_null_for_values_that_are_not_finite(parts):
    estimate, capture = parts
    plain = report(evaluate(estimate, capture, EvaluateConfig(**FEW)))
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["surface"]["whole"]["thresholds"][0]["threshold_percent"] == 0.25
    assert plain["dtu"] is None
    bare = capture.replace(truth=Truth(lights_world=capture.truth.lights_world))
    found = evaluate(estimate, bare, EvaluateConfig(**FEW))  # only cameras and lights
    assert (found.surface, found.views) == (None, ())
    assert found.lights.mean_deg < 1e-5
    assert report(found)["cameras"]["mean_center_percent"] is None


def test_every_row_has_a_unit_and_a_meaning(parts):
    sections = rows(evaluate(*parts, EvaluateConfig(**FEW)))
    assert [title for title, _ in sections] == [
        "alignment",
        "surface",
        "along the rays of view_2.png",
        "lights",
        "cameras",
    ]
    said = {row.name: row for _, found in sections for row in found}
    assert said["method"].meaning == "similarity on 3 cameras"
    assert said["chamfer_mean"].meaning.startswith("mean of mean accuracy")
    assert said["chamfer_sum"].meaning.startswith("sum of mean accuracy")
    assert said["missing"].value == "2 of 5"
    assert all(row.meaning for row in said.values())
