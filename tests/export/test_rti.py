import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.export.map_files import with_axes
from pimper_torch.export.rti import write_rti
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.runtime.errors import InputError
from pimper_torch.viz.maps import view_maps


@pytest.fixture
def matte(result):
    return result.replace(summary={}, reference="b.png")


def read_lp(folder):
    """Read a folder as relight does: a count, lines of four words, JPEG files in that order."""
    first, *lines = (folder / "lights.lp").read_text().splitlines()
    assert int(first) == len(lines)
    words = [line.split() for line in lines]
    pictures = sorted(folder.glob("*.jpg"))
    assert [name for name, *_ in words] == [path.name for path in pictures]
    lights = torch.tensor([[float(x), float(y), float(z)] for _, x, y, z in words])
    stack = np.stack([np.asarray(Image.open(path)) for path in pictures])
    return lights, linear_from_srgb(torch.from_numpy(stack) / 255)


def test_lights_are_unit_vectors_all_around_on_the_viewers_side(matte, tmp_path):
    write_rti(matte, tmp_path / "rti")
    lights, stack = read_lp(tmp_path / "rti")
    assert_close(lights.norm(dim=1), torch.ones(60))
    assert float(lights[:, 2].min()) > 0.25
    assert float(lights[:, :2].mean(dim=0).norm()) < 0.05
    assert stack.shape == (60, 40, 60, 3)


def test_photometric_stereo_on_the_stack_gives_the_normals_of_its_view(matte, tmp_path):
    """Solve Lambert's law by least squares for each pixel, with the lights that reach it."""
    write_rti(matte, tmp_path / "rti")
    lights, stack = read_lp(tmp_path / "rti")
    maps = view_maps(matte.mesh, matte.mesh_cameras, 1)
    grey = stack.mean(dim=-1)[:, maps.seen].mT
    reached = (grey > 0.05).float()
    normal = torch.einsum("pl,li,lj->pij", reached, lights, lights)
    found = torch.linalg.solve(normal, torch.einsum("pl,pl,li->pi", reached, grey, lights))
    expected = torch.from_numpy(with_axes(maps.normals_cam, "opengl"))[maps.seen]
    cosine = (normalize(found, dim=1) * normalize(expected, dim=1)).sum(dim=1)
    off_deg = torch.rad2deg(cosine.clamp(-1, 1).acos())
    assert len(off_deg) > 500
    assert float(off_deg.median()) < 1  # 8 bits
    assert float(off_deg.quantile(0.9)) < 4  # JPEG blends across edges of shadows
    assert bool((stack[:, ~maps.seen] < 0.01).float().mean() > 0.99)


def test_only_an_object_of_one_material_has_highlights(matte, tmp_path):
    shiny = {"metallic": 0.0, "roughness": 0.2, "specular": 1.0, "vertices": 1.0}

    def brightest(materials):
        folder = tmp_path / str(len(materials))
        write_rti(matte.replace(summary={"relighting": {"materials": materials}}), folder)
        return read_lp(folder)[1].amax(dim=0)

    plain = brightest([])
    assert float((brightest([shiny]) - plain).max()) > 0.1
    assert torch.equal(brightest([shiny, shiny]), plain)


@pytest.mark.parametrize("value", [None, "rough", float("nan")])
def test_an_invalid_material_is_refused(matte, tmp_path, value):
    bad = {"metallic": 0.0, "roughness": value, "specular": 1.0}
    summary = {"relighting": {"materials": [bad]}}
    with pytest.raises(InputError, match="3 finite numbers as metallic, roughness and specular"):
        write_rti(matte.replace(summary=summary), tmp_path / "rti")


def test_a_grey_surface_gives_grey_images(matte, tmp_path):
    mesh = matte.mesh.replace(albedo=matte.mesh.albedo[:, :1])
    write_rti(matte.replace(mesh=mesh), tmp_path / "rti")
    _, stack = read_lp(tmp_path / "rti")
    assert float(stack.max()) > 0.1
    assert_close(stack[..., 0], stack[..., 2])
