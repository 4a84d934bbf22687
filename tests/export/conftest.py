import shutil

import av
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.export import pictures, read_result, results
from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.photographs import load_views
from pimper_torch.radiometry import Encoding, to_bytes
from pimper_torch.records import CameraModel, Removal, Silhouettes
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.stages.sfm.sparse_scene import assemble_scene

ENCODING = Encoding(response="linear")


@pytest.fixture
def photographs(reconstruction, tmp_path):
    """Files of photographs, one of which is not registered."""
    folder = tmp_path / "photos"
    folder.mkdir()
    images = to_bytes(reconstruction.scene.views.images)
    for name, image in zip("abcd", [*images, images[0]], strict=True):
        array = np.ascontiguousarray(image.movedim(0, -1).numpy())
        Image.fromarray(array).save(folder / f"{name}.png")
    return folder


@pytest.fixture
def run(reconstruction, photographs):
    """A run on these photographs, which have lens distortion."""
    scene = reconstruction.scene
    lens = CameraModel(
        camera=1, model="SIMPLE_RADIAL", params=(90.0, 31.0, 19.0, 0.1), width=60, height=40
    )
    rays = transform(scene.cameras.cam_from_world, scene.points_world).reshape(-1, 3)
    model = SparseModel(
        names=scene.views.names,
        lenses=(lens,) * 3,
        cam_from_world=scene.cameras.cam_from_world.double(),
        points_world=scene.points_world.double(),
        observation_point=scene.observation_point,
        observation_view=scene.observation_view,
        observation_pixels=distort(lens, rays.double()),
    )
    scene = assemble_scene(load_views(photographs, encoding=ENCODING), model)
    generator = torch.Generator().manual_seed(56)
    silhouettes = Silhouettes(
        inside=(torch.rand(3, 40, 60, generator=generator) > 0.5).float(),
        reliable=torch.tensor([True, False, True]),
        source="found",
    )
    doubted = Removal(
        guard="silhouettes.unreliable",
        what="photographs",
        count=1,
        total=3,
        reason="",
        names=("b.png",),
    )
    return reconstruction.replace(scene=scene, silhouettes=silhouettes, left_out=(doubted,))


@pytest.fixture
def without_pictures(monkeypatch, lit_before):
    """Skip images: they are not read back, and take most of the time."""
    for draw in ("draw_overview", "draw_turn"):
        monkeypatch.setattr(pictures, draw, lambda *given: given[-1].write(b"-"))


@pytest.fixture
def folder(run, photographs, tmp_path, tmp_path_factory, without_pictures):
    """The result folder of that run, copied from one that is written once."""
    kept, out = tmp_path_factory.getbasetemp() / "exchange", tmp_path / "out"
    if not kept.exists():
        config = CoarseToFineConfig(photographs=ENCODING)
        results.write_result(run, config, kept, about={"photographs": "HERE", "masks": None})
    shutil.copytree(kept, out)
    summary = (out / "summary.json").read_text().replace("HERE", str(photographs))
    (out / "summary.json").write_text(summary)
    return out


@pytest.fixture
def result(folder):
    """The result read from that folder."""
    return read_result(folder)


@pytest.fixture
def read_exr():
    """Read an OpenEXR file by FFmpeg."""

    def read(path):
        with av.open(str(path)) as file:
            return next(file.decode(video=0)).to_ndarray()

    return read


@pytest.fixture
def same_cameras():
    """Compare cameras with those of a result, as numbers in text may differ."""

    def compare(found, expected):
        assert_close(found.intrinsics, expected.intrinsics, rtol=0, atol=1e-9)
        assert_close(found.cam_from_world, expected.cam_from_world, rtol=0, atol=1e-9)
        assert torch.equal(found.sizes_px, expected.sizes_px)

    return compare
