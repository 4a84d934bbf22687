import numpy as np
import pytest
import torch
from PIL import Image

from pimper_torch.cli.gamma import advice
from pimper_torch.cli.main import main
from pimper_torch.single_view.factorization import estimate_gamma
from pimper_torch.single_view.factorization.estimate_gamma import GammaEstimate


@pytest.fixture
def fixed(tmp_path):
    """A ball under ten point lights in a dark room, gamma 1.8, on a bright card; and the ball's
    mask."""
    generator = np.random.default_rng(3)
    y, x = np.mgrid[-1:1:40j, -1:1:40j]
    inside = x**2 + y**2 < 0.8
    normals = np.stack([x, y, -np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))], axis=-1)
    albedo = 0.4 + 0.5 * generator.random((40, 40))
    (tmp_path / "photos").mkdir()
    for index in range(10):
        point_light = np.append(0.6 * generator.standard_normal(2), -1)
        radiance = albedo * np.clip(normals @ (point_light / np.linalg.norm(point_light)), 0, None)
        radiance = np.where(inside, radiance, generator.random())
        encoded = (255 * radiance ** (1 / 1.8)).round().astype(np.uint8)
        Image.fromarray(encoded).save(tmp_path / "photos" / f"{index}.png")
    Image.fromarray(255 * inside.astype(np.uint8)).save(tmp_path / "mask.png")
    return tmp_path


def test_the_gamma_of_a_folder_is_printed_with_the_option_to_set_it(fixed, capsys):
    mask = str(fixed / "mask.png")
    assert main(["gamma", str(fixed / "photos"), "--mask", mask, "--rank", "3"]) == 0
    output = capsys.readouterr().out
    found = float(output.split()[1])
    assert abs(found - 1.8) < 0.06
    assert f"--photographs.response {found:.2f}" in output


def test_the_mask_is_reduced_with_the_photographs(fixed, capsys, monkeypatch):
    given = {}

    def stand_in(views, *, mask, rank):
        given.update(views=views, mask=mask)
        return estimate(1.81, (0.005, 0.012, 0.009))

    monkeypatch.setattr(estimate_gamma, "gamma_of_photographs", stand_in)
    options = ["--mask", str(fixed / "mask.png"), "--max-size-px", "20"]
    assert main(["gamma", str(fixed / "photos"), *options]) == 0
    assert given["views"].images.shape[-2:] == given["mask"].shape == (20, 20)
    assert abs(float(given["mask"].double().mean()) - 0.2 * torch.pi) < 0.03  # x^2 + y^2 < 0.8


def test_a_user_error_is_one_message(fixed, capsys):
    for path in sorted((fixed / "photos").iterdir())[4:]:
        path.unlink()
    assert main(["gamma", str(fixed / "photos")]) == 2
    assert "samples are lit in more than 4 of 4 views" in capsys.readouterr().err
    assert main(["gamma", str(fixed / "photos"), "--mask", str(fixed / "none.png")]) == 2
    assert "none.png: there is no such file; needed: a mask" in capsys.readouterr().err


def estimate(gamma, residuals, determined=True):
    names = ("residual", "residual_linear", "residual_srgb")
    known = {"gamma": gamma, "determined": determined, **dict(zip(names, residuals, strict=True))}
    return GammaEstimate(standard_error=0.05, entries=1000, **known)


@pytest.mark.parametrize(
    ("gamma", "residuals", "advised"),
    [
        (1.04, (0.005, 0.0051, 0.009), " linear"),
        (2.25, (0.005, 0.012, 0.0049), " srgb"),
        (1.81, (0.005, 0.012, 0.009), " 1.81"),
    ],
)
def test_the_simplest_curve_that_fits_is_advised(gamma, residuals, advised):
    assert advice(estimate(gamma, residuals)).endswith(advised)
    assert advice(estimate(gamma, residuals, determined=False)) == ""


def test_an_undetermined_gamma_advises_no_option(fixed, capsys, monkeypatch):
    undetermined = estimate(1.81, (0.2, 0.3, 0.3), determined=False)
    monkeypatch.setattr(estimate_gamma, "gamma_of_photographs", lambda *_, **__: undetermined)
    assert main(["gamma", str(fixed / "photos")]) == 0
    output = capsys.readouterr().out
    assert "a moved camera" in output
    assert "--photographs.response" not in output
