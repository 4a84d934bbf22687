import warnings

import pytest
import torch
from sparse_models import views_of
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.priors import salient_networks, segmenter
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.runtime.errors import ConfigError, InputError, PimperWarning
from pimper_torch.runtime.events import Progress
from pimper_torch.runtime.stream import collected
from pimper_torch.store import Store
from tests.priors.onnx_files import brightness, model


@pytest.fixture
def views():
    """Two photographs of different sizes with smooth colours, one brighter from left to right."""
    images = torch.zeros(2, 3, 40, 60)
    images[0] = torch.linspace(0.1, 0.9, 60)
    images[1, :, :24, :30] = torch.linspace(0.2, 0.6, 24)[:, None]
    return views_of(images, [(60, 40), (30, 24)], names=("a.png", "b.png"))


@pytest.fixture
def network(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "bright.onnx"
    path.write_bytes(brightness())
    return path


@pytest.fixture
def home(tmp_path, monkeypatch):
    """rembg with a home folder that is empty, and without a connection."""
    pytest.importorskip("rembg")

    def refuse(*_, **__):
        raise OSError("no connection")

    monkeypatch.setenv("U2NET_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("pooch.retrieve", refuse)
    return tmp_path / "home"


def calls_of(monkeypatch):
    """List the photographs that networks get from now on."""
    calls, predicted = [], segmenter._silhouette
    monkeypatch.setattr(
        segmenter,
        "_silhouette",
        lambda predict, image: calls.append(tuple(image.shape[1:])) or predicted(predict, image),
    )
    return calls


def brightness_of(views, view):
    width, height = views.sizes_px[view].tolist()
    grey = srgb_from_linear(views.images[view, :, :height, :width]).mean(dim=0)
    return (grey - grey.min()) / (grey.max() - grey.min())


def test_a_file_gives_the_saliency_of_each_photograph(views, network):
    with collected(Progress) as reports:
        prior = pt.segment(views, network)
    assert reports[-1] == Progress(done=2, total=2)
    assert prior.names == views.names
    assert prior.sizes_px.tolist() == [[320, 320]] * 2  # U2-Net's, as the file accepts any
    assert not prior.undistorted
    prior.check("test")
    for view, sides in enumerate([(40, 60), (24, 30)]):
        small = torch.nn.functional.interpolate(
            prior.inside[view : view + 1, None], sides, mode="bilinear", antialias=True
        )
        assert_close(small[0, 0], brightness_of(views, view), atol=0.04, rtol=0)
    assert torch.equal(prior.inside, pt.segment(views, str(network)).inside)


def test_a_photograph_without_contrast_is_unknown(views, network):
    grey = views.replace(images=torch.full_like(views.images, 0.3))
    assert set(pt.segment(grey, network).inside.unique().tolist()) == {0.5}


def test_maps_are_kept_by_photograph_and_network(views, network, tmp_path, monkeypatch):
    calls, cache = calls_of(monkeypatch), Store(folder=tmp_path / "kept")
    first = pt.segment(views, network, cache=cache)
    assert sorted(calls) == [(24, 30), (40, 60)]
    renamed = pt.segment(views.replace(names=("c.png", "d.png")), network, cache=tmp_path / "kept")
    assert len(calls) == 2
    assert renamed.names == ("c.png", "d.png")
    assert torch.equal(renamed.inside, first.inside)
    images = views.images.clone()
    images[0, 0, 3, 4] = 0.95
    pt.segment(views.replace(images=images), network, cache=cache)
    assert calls[2:] == [(40, 60)]
    network.write_bytes(model([("Sub", ("picture", "picture"), "no")], {}, ("no",)))
    with pytest.raises(InputError, match="returns"):
        pt.segment(views, network, cache=cache)


@pytest.mark.slow  # the first import of rembg compiles for minutes
def test_a_name_is_run_by_rembg_and_nothing_is_downloaded_if_it_is_there(views, network, home):
    home.mkdir()
    network.rename(home / "u2net.onnx")
    with warnings.catch_warnings():
        warnings.simplefilter("error", PimperWarning)
        prior = pt.segment(views, "rembg", cache=home / "kept")
        (home / "u2net.onnx").unlink()  # no photograph needs it again
        again = pt.segment(views, "u2net", cache=home / "kept")
    assert torch.equal(again.inside, prior.inside)
    assert prior.sizes_px.tolist() == [[60, 40], [30, 24]]
    for view in range(2):
        expected = brightness_of(views, view)
        height, width = expected.shape
        assert_close(prior.inside[view, :height, :width], expected, atol=0.04, rtol=0)


@pytest.mark.slow  # the first import of rembg compiles for minutes
def test_large_photographs_get_maps_of_1024_pixels(network, home):
    home.mkdir()
    network.rename(home / "u2netp.onnx")
    large = views_of(torch.linspace(0, 1, 1500).expand(1, 3, 600, 1500))
    assert pt.segment(large, "u2netp").sizes_px.tolist() == [[1024, 410]]


@pytest.mark.slow  # the first import of rembg compiles for minutes
def test_a_download_is_announced_and_its_failure_reported(views, home):
    missing = r"u2netp is not on this machine: rembg downloads it from .* to .*home.models.u2netp"
    with (
        pytest.warns(PimperWarning, match=missing),
        pytest.raises(
            InputError, match=r"opened by rembg \(no connection\); needed: .*u2netp.onnx"
        ),
    ):
        pt.segment(views, "u2netp")


@pytest.mark.slow  # the first import of rembg compiles for minutes
@pytest.mark.usefixtures("home")
@pytest.mark.parametrize("name", ["u3net", "atlascloud", "sam", "u2net_custom"])
def test_unusable_names_are_refused(name, views):
    with pytest.raises(
        ConfigError, match=f"segmenter is '{name}'; needed: an ONNX file, or one of"
    ):
        pt.segment(views, name)


def test_a_missing_package_is_reported(views, monkeypatch):
    monkeypatch.setattr(salient_networks, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'pimper_torch\[segment\]'\. Or give the"):
        pt.segment(views)


@pytest.mark.parametrize("name", ["net.onnx", "folder/net"])
def test_a_missing_file_is_refused(name, views, tmp_path):
    with pytest.raises(InputError, match="found nothing; needed: the ONNX file of a salient"):
        pt.segment(views, tmp_path / name)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([("Neg", ("picture",), "map")], r"returns \(1, 3, 320, 320\) with values from"),
        (
            [("Conv", ("picture", "grey"), "grey map"), ("Mul", ("grey map", "nine"), "map")],
            r"returns \(1, 1, 320, 320\) with values from .* from 0 to 1. Call other networks by",
        ),
        ([("Conv", ("picture", "narrow"), "map")], "cannot be run by onnxruntime"),
    ],
)
def test_networks_of_another_kind_are_refused(nodes, message, views, network):
    constants = {
        "grey": ((1, 3, 1, 1), (1.0, 1.0, 1.0)),
        "narrow": ((1, 2, 1, 1), (1.0, 1.0)),
        "nine": ((), (9.0,)),
    }
    network.write_bytes(model(nodes, constants, ("map",)))
    with pytest.raises(InputError, match=message):
        pt.segment(views, network)
    network.write_bytes(b"none")
    with pytest.raises(InputError, match="cannot be opened by onnxruntime"):
        pt.segment(views, network)
