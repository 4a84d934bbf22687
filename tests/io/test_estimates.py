import json

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_bench.metrics.estimates import estimate_of, read_estimate
from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.export import results
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.io.meshes import write_ply
from pimper_torch.runtime.errors import InputError


@pytest.fixture
def folder(reconstruction, tmp_path, small_pictures):
    every = MeshFiles(faces="all")
    results.write_result(reconstruction, CoarseToFineConfig(), tmp_path / "out", files=every)
    return tmp_path / "out"


def test_a_result_survives_a_round_trip(folder, reconstruction):
    found = read_estimate(folder)
    assert_close(found.mesh.vertices_world, reconstruction.mesh.vertices_world.double())
    assert torch.equal(found.mesh.faces, reconstruction.mesh.faces)
    assert_close(found.mesh.confidence, reconstruction.mesh.confidence.double())
    assert found.names == ("a.png", "b.png", "c.png")
    assert found.reference == "b.png"
    cameras = reconstruction.cameras
    assert_close(found.cameras.intrinsics, cameras.intrinsics.double())
    assert_close(found.cameras.cam_from_world, cameras.cam_from_world.double())
    assert torch.equal(found.cameras.sizes_px, cameras.sizes_px)


def test_a_result_is_the_same_in_memory_and_from_its_folder(folder, reconstruction):
    said, read = estimate_of(reconstruction), read_estimate(folder)
    assert (said.names, said.reference) == (read.names, read.reference)
    assert_close(
        said.lights_world.double(), read.lights_world.double(), rtol=1e-5, atol=1e-6, equal_nan=True
    )
    assert_close(said.mesh.vertices_world, read.mesh.vertices_world.to(said.mesh.vertices_world))


def test_lights_are_paired_by_name_and_unknown_ones_are_nan(folder):
    report = json.loads((folder / "lights.json").read_text())
    lights = {view["name"]: view["light"] for view in report["views"]}
    assert None in lights.values()  # or the test is void
    report["views"].reverse()
    (folder / "lights.json").write_text(json.dumps(report))
    found = read_estimate(folder)
    for name, light in zip(found.names, found.lights_world, strict=True):
        if lights[name] is None:
            assert light.isnan().all()
        else:
            assert_close(light, torch.tensor(lights[name], dtype=torch.float64))


def test_a_mesh_alone_is_an_estimate(reconstruction, tmp_path):
    write_ply(reconstruction.mesh, tmp_path / "any.ply")
    found = read_estimate(tmp_path / "any.ply")
    assert len(found.mesh.vertices_world) == len(reconstruction.mesh.vertices_world)
    assert found.names == ()
    assert found.cameras is None
    assert found.lights_world is None
    assert found.reference is None


def test_a_folder_with_only_a_mesh_is_an_estimate(folder):
    for name in ("lights.json", "depth.npz"):
        (folder / name).unlink()
    found = read_estimate(folder)
    assert found.lights_world is None
    assert found.reference is None
    assert found.cameras.num_views == 3


@pytest.mark.parametrize(
    "text", ["nonsense", "[1, 2]", '{"views": [{"name": "a.png", "light": [1, 2]}]}', "[" * 9999]
)
def test_invalid_lights_are_refused(folder, text):
    (folder / "lights.json").write_text(text)
    needed = r"cannot be read as JSON|not the layout .*(a JSON object|4 finite numbers)"
    with pytest.raises(InputError, match=rf"lights\.json: ({needed})"):
        read_estimate(folder)


def test_a_damaged_or_pickled_depth_file_is_refused(folder):
    (folder / "depth.npz").write_bytes(b"PK nothing")
    with pytest.raises(InputError, match=r"depth\.npz: cannot be read"):
        read_estimate(folder)
    np.savez(folder / "depth.npz", name=np.array([{"harm": 1}], dtype=object))
    with pytest.raises(InputError, match=r"depth\.npz: cannot be read"):
        read_estimate(folder)
