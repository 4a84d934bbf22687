"""Different frames of a result and the truth are refused with their difference."""

import pytest
import torch

from pimper_bench.metrics import EvaluateConfig, evaluate
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.frames import Frames
from pimper_torch.geometry.rigid import rigid
from pimper_torch.runtime.errors import InputError, PimperWarning

FEW = {"samples": 3000}
IDENTITY = torch.eye(3).double()
# x, y, z of the truth are x, z, -y of the result: y up in one, z up in the other.
Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
AROUND = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def by(linear, shift=(0.0, 0.0, 0.0)):
    return rigid(linear, torch.tensor(shift, dtype=torch.float64))


@pytest.fixture
def truth(make):
    """A potato away from the origin, without symmetries."""
    return make.moved(make.potato(), by(IDENTITY, (0.5, 1.0, 2.0)))


DIFFERENCES = [
    (by(0.001 * IDENTITY), ["enlarged by a factor of 1000 (metres and millimetres?)."]),
    (by(1000 * IDENTITY), ["reduced by a factor of 1000 (metres and millimetres?)."]),
    (by(25.4 * IDENTITY), ["reduced by a factor of 25.4 (inches and millimetres?)."]),
    (by(IDENTITY, (40.0, 0.0, -5.0)), ["They fit if the result is moved by (-40, ", ", 5"]),
    (by(IDENTITY, (1e5, 0.0, 0.0)), ["moved by (-1e+05, "]),
    (by(Y_UP.mT), ["They fit if x, y, z of the truth are x, z, -y of the result."]),
    (
        by(0.01 * Y_UP.mT, (3.0, 0.0, 0.0)),
        ["by a factor of 100 (metres and centi", "x, z, -y of the result", "moved by (-300"],
    ),
]


@pytest.mark.parametrize(("result_from_truth", "message"), DIFFERENCES)
def test_different_units_axes_and_positions_are_refused_with_a_suggestion(
    make, truth, result_from_truth, message
):
    estimate = Estimate(mesh=make.moved(truth, result_from_truth))
    with pytest.raises(InputError) as refused:
        evaluate(estimate, make.capture_of(truth), EvaluateConfig(**FEW))
    for part in (*message, "`--alignment icp` starts from that"):
        assert part in str(refused.value)


@pytest.mark.parametrize("result_from_truth", [one for one, _ in DIFFERENCES])
def test_icp_starts_from_the_suggestion_and_converges_to_the_truth(make, truth, result_from_truth):
    estimate = Estimate(mesh=make.moved(truth, result_from_truth))
    config = EvaluateConfig(alignment="icp", **FEW)
    found = evaluate(estimate, make.capture_of(truth), config)
    assert "by a guess" in found.alignment.description
    assert found.surface.whole.chamfer_mean_percent < 0.01
    assert torch.allclose(
        found.alignment.truth_from_world @ result_from_truth, torch.eye(4).double(), atol=1e-3
    )


def test_a_mismatch_without_a_suggestion_is_refused_quickly(make, truth):
    elsewhere = make.moved(make.half_sphere(level=6), by(IDENTITY, (1e5, 1e5, 0.0)))
    with pytest.raises(InputError, match=r"centres are 1\.414e\+05 apart\. Transform the result"):
        evaluate(Estimate(mesh=elsewhere), make.capture_of(truth), EvaluateConfig())


@pytest.mark.parametrize(
    "bad",
    [
        lambda make, truth: make.moved(truth, by(1.3 * IDENTITY)),
        lambda make, truth: make.half_sphere(),
        lambda make, truth: make.moved(make.square(side=12.0), by(IDENTITY, (-6.0, -6.0, 1.2))),
    ],
    ids=["a third larger", "half of a different object", "mostly the table"],
)
def test_inaccurate_results_in_the_right_frame_are_measured(make, truth, bad):
    where = by(IDENTITY, (-0.5, -1.0, -2.0))
    mesh = make.moved(truth, where)
    assert Frames(bad(make, mesh), mesh).guess() is None
    found = evaluate(Estimate(mesh=bad(make, mesh)), make.capture_of(mesh), EvaluateConfig(**FEW))
    assert found.surface.whole.chamfer_mean_percent > 3


def turned(cameras, turns):
    """Rotate each camera about its axes, as for rotated photographs."""
    rotations = torch.stack([turns] * cameras.num_views) if turns.ndim == 2 else turns
    whole = rigid(rotations, torch.zeros(cameras.num_views, 3).double())
    return cameras.replace(cam_from_world=whole @ cameras.cam_from_world)


QUARTER = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("turns", "message"),
    [
        (QUARTER, "turned about their optical axes by 90 degrees in the median. Does one have"),
        (QUARTER @ QUARTER, "turned about their optical axes by 180 degrees"),
        (AROUND, "their axes are opposite. Does one have OpenGL's axes"),
    ],
)
def test_cameras_that_disagree_by_their_rolls_are_refused(make, truth, turns, message):
    cameras = make.cameras()
    capture = make.capture_of(truth, cameras=cameras)
    names = capture.views.names
    estimate = Estimate(mesh=truth, names=names, cameras=turned(cameras, turns))
    with pytest.raises(InputError) as refused:
        evaluate(estimate, capture, EvaluateConfig(**FEW))
    assert message in str(refused.value)
    assert "`--alignment icp` starts without their rolls" in str(refused.value)
    for method in ("icp", "none"):
        with pytest.warns(
            PimperWarning, match="positions of the cameras of result and truth agree"
        ):
            found = evaluate(estimate, capture, EvaluateConfig(alignment=method, **FEW))
        assert found.surface.whole.chamfer_mean_percent < 0.01
        assert found.cameras is None


def test_one_rotated_photograph_is_not_refused(make, truth):
    cameras = make.cameras()
    one = torch.stack([IDENTITY] * 5)
    one[2] = QUARTER
    capture = make.capture_of(truth, cameras=cameras)
    names = capture.views.names
    estimate = Estimate(mesh=truth, names=names, cameras=turned(cameras, one))
    evaluate(estimate, capture, EvaluateConfig(alignment="cameras", **FEW))
