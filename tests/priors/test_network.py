import pytest
import torch
from sparse_models import views_of
from torch import nn
from torch.nn.functional import avg_pool2d, interpolate, normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.priors.map_config import DEPTH_ERROR
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.runtime.errors import ConfigError, InputError
from tests.priors.onnx_files import model


@pytest.fixture
def views():
    """Two photographs of different sizes."""
    generator = torch.Generator().manual_seed(2)
    images = torch.rand(2, 3, 20, 30, generator=generator)
    images[1, :, 12:], images[1, :, :, 16:] = 0, 0
    return views_of(images, [(30, 20), (16, 12)], names=("a.png", "b.png"))


class Coarse(nn.Module):
    """Predicts normals and their variance at half the size, by one convolution."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.mix = nn.Conv2d(3, 4, 1)

    def forward(self, picture):
        found = self.mix(avg_pool2d(picture, 2))
        return normalize(found[:, :3], dim=1), 0.01 + found[:, 3:].square()


def test_a_network_predicts_a_prior_from_each_photograph(views):
    seen = []

    def network(picture):
        seen.append(picture)
        return Coarse()(picture)

    found = pt.priors_of(network, views, "normals", axes="opencv")
    assert [tuple(one.shape) for one in seen] == [(1, 3, 20, 30), (1, 3, 12, 16)]
    assert_close(seen[1][0], srgb_from_linear(views.images[1, :, :12, :16]))
    assert found.names == views.names
    assert found.sizes_px.tolist() == [[15, 10], [8, 6]]
    assert not found.undistorted
    for index, picture in enumerate(seen):
        normals, variance = Coarse()(picture)
        height, width = normals.shape[-2:]
        assert_close(found.normals[index, :height, :width], normals[0].movedim(0, -1))
        assert_close(found.variance[index, :height, :width], variance[0, 0])
    assert found.variance[1, 6:].isinf().all()
    assert found.variance[1, :, 8:].isinf().all()
    found.check("test")


def test_images_are_normalized_as_requested_by_the_network(views):
    seen = []

    def network(picture):
        seen.append(picture)
        return picture[:, 0]

    mean, std = (0.5, 0.4, 0.3), (0.2, 0.25, 0.5)
    found = pt.priors_of(
        network, views, "depth", size_px=(14, 28), linear=True, mean=mean, std=std, inverse=True
    )
    assert found.sizes_px.tolist() == [[14, 28], [14, 28]]
    whole = interpolate(views.images[1:, :, :12, :16], (28, 14), mode="bilinear", antialias=True)
    expected = (whole[0] - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None]
    assert_close(seen[1][0], expected)
    assert found.inverse
    # One standard error for all, relative to the range of values without its ends.
    known = found.variance[0].isfinite()
    ends = found.depth[0][known].quantile(torch.tensor([0.02, 0.98]))
    error = (DEPTH_ERROR * ends.diff()) ** 2
    assert_close(found.variance[0][known], error.expand(int(known.sum())))


def test_grey_photographs_are_passed_with_three_channels(views):
    grey = views.replace(images=views.images[:, :1])
    found = pt.priors_of(lambda picture: picture, grey, "albedo", linear=True, error=0.1)
    assert_close(found.albedo[0], views.images[0, :1].expand(3, -1, -1))
    assert_close(found.variance[0], torch.full((20, 30), 0.01))
    with pytest.raises(ConfigError, match="error is nan; needed: above 0, where the network"):
        pt.priors_of(lambda picture: picture, grey, "albedo")


@pytest.mark.parametrize(("kind", "field"), [("inliers", "probability"), ("silhouettes", "inside")])
def test_probabilities_become_inlier_and_silhouette_priors(kind, field, views):
    found = pt.priors_of(lambda picture: picture[:, :1], views, kind, linear=True)
    assert_close(getattr(found, field)[0], views.images[0, 0])
    found.check("test")


def test_predictions_for_a_scene_use_its_undistorted_photographs(reconstruction):
    scene = reconstruction.scene
    found = pt.priors_of(lambda picture: picture[:, :1], scene, "silhouettes")
    assert found.undistorted
    given = scene.replace(views=scene.views.replace(priors=(found,)))
    assert pt.resolve_prior_conventions(given) == given


def test_gradients_of_the_parameters_agree_with_finite_differences(views):
    network = Coarse().double()
    exact = views.to(torch.float64)
    parameters = dict(network.named_parameters())

    def guess(*values):
        made = dict(zip(parameters, values, strict=True))
        prior = pt.priors_of(
            lambda picture: torch.func.functional_call(network, made, picture), exact, "normals"
        )
        known = prior.variance.isfinite()
        return prior.normals[known], prior.variance[known]

    given = [one.detach().clone().requires_grad_() for one in parameters.values()]
    assert torch.autograd.gradcheck(guess, given)


ONE, TWO = {"one": ((), (1.0,))}, {"two": ((), (2.0,))}
GREY = {"grey": ((1, 3, 1, 1), (0.25, 0.5, 0.25))}


def test_an_onnx_file_gives_the_output_of_its_nodes(views, tmp_path):
    """The map is 2 x - 1; a second output is ignored."""
    pytest.importorskip("onnxruntime")
    nodes = [
        ("Mul", ("picture", "two"), "double"),
        ("Sub", ("double", "one"), "map"),
        ("Neg", ("map",), "else"),
    ]
    path = tmp_path / "net.onnx"
    path.write_bytes(model(nodes, ONE | TWO, ("map", "else")))
    found = pt.priors_of(path, views, "albedo", linear=True, error=0.5)
    assert_close(found.albedo[1, :, :12, :16], 2 * views.images[1, :, :12, :16] - 1)
    assert_close(found.variance[0], torch.full((20, 30), 0.25))
    torch.set_num_threads(2)
    again = pt.priors_of(str(path), views, "albedo", linear=True, error=0.5)
    torch.set_num_threads(1)
    assert torch.equal(again.albedo, found.albedo)
    loaded = pt.priors_of(pt.priors.from_onnx(path), views, "albedo", linear=True, error=0.5)
    assert torch.equal(loaded.albedo, found.albedo)
    with pytest.raises(
        InputError, match=r"returns \(1, 3, 20, 30\); needed for depth: a map \(1, 1"
    ):
        pt.priors_of(path, views, "depth")


def test_an_output_named_variance_is_the_variance(views, tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "net.onnx"
    nodes = [
        ("Conv", ("picture", "grey"), "map"),
        ("Neg", ("picture",), "else"),
        ("Mul", ("map", "two"), "variance"),
    ]
    path.write_bytes(model(nodes, TWO | GREY, ("map", "else", "variance")))
    found = pt.priors_of(path, views, "depth", linear=True)
    weights = torch.tensor([0.25, 0.5, 0.25])
    mixed = torch.einsum("c,chw->hw", weights, views.images[0])
    assert_close(found.depth[0], mixed)
    assert_close(found.variance[0], 2 * mixed)


@pytest.mark.parametrize("name", ["net.pt2", "net.pt", "net.safetensors"])
def test_files_that_hold_pickles_are_refused(name, views, tmp_path):
    with pytest.raises(InputError, match="which can run any code when they are loaded"):
        pt.priors_of(tmp_path / name, views, "depth")


def test_a_damaged_onnx_file_and_a_missing_package_are_reported(views, tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "net.onnx"
    path.write_bytes(b"none")
    with pytest.raises(InputError, match="cannot be opened by onnxruntime"):
        pt.priors_of(path, views, "depth")
    monkeypatch.setattr("pimper_torch.priors.network.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'pimper_torch\[onnx\]'"):
        pt.priors_of(path, views, "depth")


@pytest.mark.parametrize(
    ("network", "found"),
    [
        (lambda picture: picture.mean(), r"\(\)"),
        (lambda picture: {"normals": picture}, "dict"),
        (lambda picture: picture[:, :2], r"\(1, 2, 20, 30\)"),
        (lambda picture: (picture, picture[..., 1:]), r"\(1, 3, 20, 30\)"),
    ],
)
def test_an_invalid_network_output_is_refused(network, found, views):
    with pytest.raises(InputError, match=f"The network returns {found}; needed for normals: a map"):
        pt.priors_of(network, views, "normals")
