import numpy as np
import pytest
import torch
from PIL import Image
from sparse_models import views_of

from pimper_torch.cli.options import parse
from pimper_torch.io.decode import write_deep_png
from pimper_torch.priors.prior_files.read_silhouettes import object_at, read_silhouettes
from pimper_torch.runtime.errors import ConfigError, InputError
from pimper_torch.scale.given import Mark, PixelMark

SOFT = np.linspace(0, 1, 24 * 16).reshape(16, 24).astype(np.float32)


@pytest.fixture
def views():
    return views_of(torch.full((3, 3, 32, 48), 0.5), names=("a.jpg", "b.jpg", "c.jpg"))


def write_bytes(path, values):
    Image.fromarray((255 * values).round().astype(np.uint8)).save(path)


def write_deep(path, values):
    levels = (65535 * values).round().astype(np.uint16)
    write_deep_png(np.ascontiguousarray(levels[..., None].repeat(3, axis=-1)), path)


def write_cut_out(path, values):
    rgba = np.full((*values.shape, 4), 90, np.uint8)
    rgba[..., 3] = (255 * values).round()
    Image.fromarray(rgba).save(path)


@pytest.mark.parametrize(
    ("name", "write", "error"),
    [
        ("b.png", write_bytes, 0.5 / 255),
        ("b_mask.png", write_deep, 2e-5),
        ("b.jpg", write_bytes, 0.02),
        ("b.jpg.png", write_cut_out, 0.5 / 255),
        ("b.npy", lambda path, one: np.save(path, one), 1e-6),
        ("b_silhouette.npz", lambda path, one: np.savez(path, mask=one), 1e-6),
        ("b.npy", lambda path, one: np.save(path, (255 * one).round().astype(np.uint8)), 0.5 / 255),
    ],
)  # fmt: skip
def test_every_file_format_gives_the_same_mask(views, tmp_path, name, write, error):
    write(tmp_path / name, SOFT)
    prior = read_silhouettes(tmp_path, views)
    assert prior.names == ("b.jpg",)
    assert prior.sizes_px.tolist() == [[24, 16]]
    assert not prior.undistorted
    off = (prior.inside[0] - torch.from_numpy(SOFT)).abs().max()
    assert off <= error + 1e-6  # float32


def test_labels_and_unknown_pixels_are_read(views, tmp_path):
    Image.fromarray(np.eye(16, 24, dtype=np.uint8)).save(tmp_path / "a.png")
    labels = np.arange(16 * 24).reshape(16, 24) % 4
    Image.fromarray(labels.astype(np.uint16)).save(tmp_path / "b.png")
    prior = read_silhouettes(tmp_path, views)
    assert torch.equal(prior.inside[1], torch.from_numpy(labels > 0).float())
    (tmp_path / "b.png").unlink()
    np.save(tmp_path / "c.npy", np.where(np.eye(16, 24) > 0, np.nan, 0.25))
    prior = read_silhouettes(tmp_path, views)
    assert prior.names == ("a.jpg", "c.jpg")
    eye = torch.eye(16, 24)
    assert torch.equal(prior.inside[0], eye)
    assert torch.equal(prior.inside[1], 0.25 + 0.25 * eye)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("b.npy", 8 * SOFT - 4, "b.npy: contains values from -4 to 4; needed: the probability"),
        ("b.npy", SOFT.T, "b.npy: is 16 x 24, but the photograph b.jpg is 48 x 32; it seems"),
        ("b.npy", np.stack([SOFT, SOFT, 1 - SOFT], axis=-1), "has colours"),
        ("b.npy", np.rint(255 * SOFT / SOFT.max()), "from 0 to 255; .*Divide the values by 255"),
        ("b.npy", np.stack([SOFT] * 4), "a stack of 4 maps; .* named like its photogr"),
        ("d.npy", SOFT, "no map for a.jpg, b.jpg, c.jpg, and no photograph for d.npy"),
        ("b.npy", np.array(["object"]), "needed: real numbers"),
    ],
)
def test_masks_of_other_photographs_are_refused(views, tmp_path, name, values, message):
    np.save(tmp_path / name, values)
    with pytest.raises(InputError, match=message):
        read_silhouettes(tmp_path, views)


def test_clicks_are_read_as_foreground_seeds(views):
    in_files = Mark(pointers=(PixelMark(name="c", x=475.0, y=3.0, size_px=(480, 320)),))
    prior = object_at([Mark.read("a.jpg,10.5,20.5"), in_files, in_files], views)
    assert prior.names == ("a.jpg", "c.jpg")
    assert prior.sizes_px.tolist() == [[48, 32]] * 2
    assert set(prior.inside.unique().tolist()) == {0.5, 1.0}
    assert (prior.inside[0] == 1).nonzero().float().mean(dim=0).tolist() == [20, 10]
    assert (prior.inside[1] == 1).nonzero().tolist() == [[0, 46], [0, 47], [1, 46], [1, 47]]
    with pytest.raises(InputError, match="outside the photograph, which has 48 x 32"):
        object_at([Mark.read("a,60,1")], views)
    with pytest.raises(InputError, match="'e': no photographs have this name"):
        object_at([Mark.read("e,6,1")], views)


@pytest.mark.parametrize("given", [["--silhouettes", "soft"], ["--object-at", "a.jpg,3,4"]])
def test_given_masks_exclude_silhouette_priors(given):
    message = r"is '(soft|a\.jpg,3,4)'; needed: no value together with --masks"
    with pytest.raises(ConfigError, match=message):
        parse("reconstruct", ["photos", "-o", "out", "--masks", "drawn", *given])
