import json

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close

import pimper_torch as pt
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.rigid import transform
from pimper_torch.radiometry.base_color import albedo_scale

pytestmark = pytest.mark.usefixtures("small_pictures")


def half_ball() -> pt.Mesh:
    vertices, faces = icosphere(4)
    kept = faces[(vertices[faces][..., 2] > 0).all(dim=1)]
    used, kept = torch.unique(kept, return_inverse=True)
    vertices = vertices[used].float()
    return pt.Mesh(
        vertices_world=vertices,
        faces=kept,
        normals_world=vertices,
        albedo=0.5 + 0.4 * vertices[:, :1],
        confidence=torch.ones(len(vertices)),
        expected_error=torch.full((len(vertices),), 0.01),
    )


def test_a_watertight_mesh_marks_faces_that_were_not_measured(reconstruction, tmp_path):
    files = pt.MeshFiles(faces=1000, watertight=True, formats=("stl", "obj"))
    mesh = half_ball()
    pt.write_result(reconstruction.replace(mesh=mesh), pt.Encoding(), tmp_path / "out", files=files)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    ply = trimesh.load(tmp_path / "out" / "mesh.ply", process=False)
    assert ply.is_watertight
    assert 950 <= len(ply.faces) <= 1000
    measured = ply.metadata["_ply_raw"]["face"]["data"]["measured"].astype(bool)
    assert (~measured).sum() == summary["caps"]["faces"]
    assert measured.sum() == summary["reduced"]["faces"]
    assert summary["caps"]["borders"] == 1
    # A disk below a half ball: a third of the area.
    assert summary["caps"]["area_fraction"] == pytest.approx(1 / 3, abs=0.03)
    assert ply.volume == pytest.approx(2 / 3 * torch.pi, rel=0.1)
    known = np.zeros(len(ply.vertices), bool)
    known[ply.faces[measured]] = True
    whole = pt.read_mesh(tmp_path / "out" / "mesh.ply")
    assert np.array_equal(whole.confidence.numpy() == 0, ~known)
    glb = trimesh.load_scene(tmp_path / "out" / "mesh.glb", process=False)
    (shape,) = glb.geometry.values()
    assert np.array_equal(np.ravel(shape.vertex_attributes["_MEASURED"]) > 0, known)
    obj = (tmp_path / "out" / "mesh.obj").read_text().splitlines()
    at = obj.index("g caps")
    assert sum(line.startswith("f ") for line in obj[at:]) == summary["caps"]["faces"]


def test_written_meshes_are_read_by_other_programs(reconstruction, tmp_path):
    files = pt.MeshFiles(faces="all", formats=("obj",))
    mesh = half_ball()
    pt.write_result(reconstruction.replace(mesh=mesh), pt.Encoding(), tmp_path / "out", files=files)
    assert not (tmp_path / "out" / "mesh.stl").exists()
    found = pt.read_mesh(tmp_path / "out" / "mesh.obj")
    corners = found.vertices_world[found.faces]
    assert_close(corners, mesh.vertices_world[mesh.faces].double(), atol=1e-7, rtol=0)
    assert (tmp_path / "out" / "asset.obj").exists()
    scaled = (mesh.albedo * albedo_scale(mesh)).clamp(0, 1).double().expand(-1, 3)
    assert_close(found.albedo, scaled, atol=0.005, rtol=0)
    assert_close(found.normals_world, mesh.normals_world.double(), atol=1e-5, rtol=0)
    loaded = trimesh.load(tmp_path / "out" / "mesh.obj", process=False)
    assert bool((loaded.face_normals[:, 2] > -0.01).all())


@pytest.mark.parametrize("metric", [False, True])
def test_far_files_have_an_offset_and_the_asset_a_translation(reconstruction, tmp_path, metric):
    offset = (448231.0, 5411923.0, 312.0)
    far = reconstruction.scene.replace(offset_world=offset)
    files = pt.MeshFiles(faces="all", formats=("stl", "obj"))
    pt.write_result(
        reconstruction.replace(mesh=half_ball(), scene=far),
        pt.Encoding(),
        tmp_path / "out",
        files=files,
        about={"scale": {"unit": "in"}} if metric else None,
    )
    shift = torch.tensor(offset).double()
    vertices = half_ball().vertices_world
    obj = pt.read_mesh(tmp_path / "out" / "mesh.obj").vertices_world
    assert_close(obj - shift, vertices.double(), atol=1e-5, rtol=0)
    data = (tmp_path / "out" / "asset.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    extras = tree["nodes"][0]["extras"]
    assert (extras["offset_world"], extras["metric"]) == (list(offset), metric)
    back = torch.tensor(extras["scene_from_asset"]).reshape(4, 4).mT.double()
    unit = float(back[:3, 0].norm())
    assert unit == pytest.approx(39.3701 if metric else 2.0, rel=1e-5 if metric else 0.01)
    for name in ("asset.obj", "asset.glb"):
        placed = pt.read_mesh(tmp_path / "out" / name).vertices_world.double()
        assert_close(placed.amin(dim=0)[1], torch.tensor(0.0).double(), atol=1e-5, rtol=0)
        world = transform(back, placed) + shift
        for one, other in zip(world.aminmax(dim=0), obj.aminmax(dim=0), strict=True):
            assert_close(one, other, atol=0.05, rtol=0)  # it has far fewer faces
    # On the bed of a printer, in millimetres: z up, the front towards -y.
    written = pt.read_mesh(tmp_path / "out" / "mesh.stl")
    low, high = written.vertices_world.aminmax(dim=0)
    assert_close(low[2], torch.tensor(0.0).double(), atol=1e-4, rtol=0)
    assert_close((low + high)[:2], torch.zeros(2).double(), atol=1e-4, rtol=0)
    unit_mm = 25.4 if metric else 50.0  # the longest side is 2 units, or 100 mm
    right, up, front = (back[:3, :3] / unit).unbind(dim=1)
    corners = unit_mm * vertices.double()[half_ball().faces] @ torch.stack([right, -front, up], 1)
    moved = written.vertices_world[written.faces] - corners
    assert_close(moved, moved[:1, :1].expand_as(moved), atol=0.02 * unit_mm, rtol=0)


def test_fewer_than_four_faces_are_refused():
    with pytest.raises(pt.ConfigError, match="faces is 3; needed: all, or at least 4"):
        pt.MeshFiles(faces=3)
