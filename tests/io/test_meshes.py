import json
import struct
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.doors.io.meshes import read_mesh, write_glb, write_ply
from pimper_torch.records import Mesh
from pimper_torch.result.viz.maps import albedo_scale
from pimper_torch.runtime.errors import InputError


@pytest.fixture
def mesh():
    generator = torch.Generator().manual_seed(31)
    normals = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    return Mesh(
        vertices_world=torch.rand(5, 3, generator=generator, dtype=torch.float64),
        faces=torch.tensor([[0, 1, 2], [2, 3, 4]]),
        normals_world=normalize(normals, dim=1),
        albedo=torch.rand(5, 3, generator=generator, dtype=torch.float64),
        confidence=torch.rand(5, generator=generator, dtype=torch.float64),
        expected_error=torch.rand(5, generator=generator, dtype=torch.float64),
    )


@pytest.mark.parametrize(("write", "suffix"), [(write_ply, ".ply"), (write_glb, ".glb")])
def test_a_mesh_comes_back_from_its_file(mesh, write, suffix, tmp_path):
    write(mesh, tmp_path / f"mesh{suffix}")
    read = read_mesh(tmp_path / f"mesh{suffix}")
    assert_close(read.vertices_world, mesh.vertices_world, rtol=0, atol=1e-7)  # float32 files
    assert torch.equal(read.faces, mesh.faces)
    assert_close(read.normals_world, mesh.normals_world, rtol=0, atol=1e-6)
    # The PLY has 8 bits, in sRGB steepest in the light: 2.3 / 255 / 2.
    tolerance = 0.006 if suffix == ".ply" else 1e-6
    albedo = (mesh.albedo * albedo_scale(mesh)).clamp(0, 1)
    assert_close(read.albedo, albedo, rtol=0, atol=tolerance)
    if suffix == ".ply":
        assert_close(read.confidence, mesh.confidence, rtol=0, atol=1e-7)
        assert_close(read.expected_error, mesh.expected_error, rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_colours_of_any_kind_that_gltf_has_are_read_as_they_are(kind, mesh, tmp_path):
    path = tmp_path / "a.glb"
    write_glb(mesh, path)
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + size])
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    top = np.iinfo(kind).max
    colors = np.random.default_rng(5).integers(0, top, (5, 4), endpoint=True).astype(kind)
    names = {np.uint8: 5121, np.uint16: 5123}
    accessor.update(componentType=names[kind], normalized=True, type="VEC4")
    accessor["bufferView"] = len(tree["bufferViews"])
    (buffer,) = tree["buffers"]
    view = {"buffer": 0, "byteOffset": buffer["byteLength"], "byteLength": colors.nbytes}
    tree["bufferViews"].append(view)
    buffer["byteLength"] += colors.nbytes
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = data[28 + size :] + colors.tobytes()
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(body))
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0")
    )
    path.write_bytes(head + chunks + body)
    wanted = torch.from_numpy(colors[:, :3].astype(np.float64) / top)
    assert_close(read_mesh(path).albedo, wanted, rtol=0, atol=1e-12)


def test_parts_of_a_scene_stand_where_the_scene_puts_them(tmp_path):
    box = trimesh.creation.box()
    moved = np.eye(4)
    moved[:3, 3] = [5, 0, 0]
    scene = trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box, transform=moved)
    scene.export(tmp_path / "two.glb")
    read = read_mesh(tmp_path / "two.glb")
    assert len(read.vertices_world) == 2 * len(box.vertices)
    assert len(read.faces) == 2 * len(box.faces)
    assert_close(read.vertices_world[:, 0].amax(), torch.tensor(5.5).double())
    assert int(read.faces[12:].min()) == len(box.vertices)  # the second refers to its own


def test_a_file_of_points_has_no_faces_and_no_made_up_normals(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\n"
    fields = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "points.ply").write_text(f"{head}{fields}end_header\n0 0 1\n1 1 1\n")
    read = read_mesh(tmp_path / "points.ply")
    assert read.faces.shape == (0, 3)
    assert read.normals_world is None
    assert_close(read.vertices_world, torch.tensor([[0.0, 0, 1], [1, 1, 1]]).double())


def test_normals_that_the_file_lacks_are_not_invented(tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    read = read_mesh(tmp_path / "one.obj")
    assert (read.normals_world, read.albedo, read.confidence) == (None, None, None)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("none.ply", None, "nothing"),
        ("mesh.ply", b"not a mesh", "cannot be read"),
        ("mesh.pkl", b"cos\nsystem\n", "cannot be read"),
        ("mesh.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("mesh.obj", b"# empty\n", "vertices|cannot be read"),
    ],
)
def test_what_is_no_mesh_is_refused(name, content, told, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=told):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize("text", [True, False])
def test_a_point_clouds_normals_are_read(tmp_path, text):
    rows = np.array([[0.5, -0.25, 1.5, 0, 0.6, 0.8], [1, 2, 3, 0, 0, 2]], dtype="<f4")
    kind = "ascii" if text else "binary_little_endian"
    names = ("x", "y", "z", "nx", "ny", "nz")
    header = f"ply\nformat {kind} 1.0\nelement vertex 2\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    lines = "".join(" ".join(str(value) for value in row) + "\n" for row in rows).encode()
    path = tmp_path / "cloud.ply"
    path.write_bytes(header.encode() + (lines if text else rows.tobytes()))
    cloud = read_mesh(path)
    assert cloud.faces.shape == (0, 3)
    wanted = torch.tensor([[0, 0.6, 0.8], [0, 0, 1]], dtype=torch.float64)
    assert_close(cloud.normals_world, wanted, rtol=0, atol=1e-6)


def ply(element, count, properties, body):
    lines = ["ply", "format binary_little_endian 1.0", f"element {element} {count}", *properties]
    return "\n".join([*lines, "end_header", ""]).encode() + body


XYZ = tuple(f"property float {axis}" for axis in "xyz")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ply("vertex", 2**40, XYZ, bytes(36))),
        ("a.ply", ply("vertex", -3, XYZ, bytes(36))),
        ("a.ply", ply("face", 2**31, ("property list uchar int vertex_indices",), bytes(9))),
        ("a.ply", ply("vertex", 4, XYZ, b"0 0 0\n" * 3).replace(b"binary_little_endian", b"ascii")),
        ("a.ply", ply("vertex", 2**40, XYZ, b"0 0 0\n").replace(b"binary_little_endian", b"ascii")),
        ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50)),
    ],
)
def test_a_count_beyond_the_files_length_is_refused_and_takes_no_memory(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match=r"says that it holds|seems damaged|holds no vertices"):
        read_mesh(tmp_path / name)
    assert tracemalloc.get_traced_memory()[1] < 1e7
    tracemalloc.stop()


def test_a_binary_ply_of_another_length_is_refused(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply("vertex", 4, XYZ, bytes(36)))
    with pytest.raises(InputError, match=r"a\.ply: cannot be read as a mesh"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda tree: tree["accessors"][0].update(count=2**40), "damaged"),
        (lambda tree: tree["accessors"][0].pop("bufferView"), "not in the file itself"),
        (lambda tree: tree["bufferViews"][0].update(byteLength=2**40), "damaged"),
        (lambda tree: tree["accessors"][0].update(type="VEC9"), "damaged"),
    ],
)
def test_a_scene_that_is_none_is_refused(mesh, change, why, tmp_path):
    write_glb(mesh, tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + size])
    change(tree)
    text = json.dumps(tree).encode()
    head = struct.pack("<4s3I4s", b"glTF", 2, len(data) - size + len(text), len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(head + text + data[20 + size :])
    with pytest.raises(InputError, match=why):
        read_mesh(tmp_path / "a.glb")


def test_a_scene_that_places_a_mesh_many_times_is_refused(mesh, tmp_path, monkeypatch):
    class Graph(dict):
        nodes_geometry = ("first", "second")

    part = SimpleNamespace(vertices=range(60_000_000))
    graph = Graph.fromkeys(Graph.nodes_geometry, (np.eye(4), "part"))
    scene = SimpleNamespace(graph=graph, geometry={"part": part})
    write_glb(mesh, tmp_path / "a.glb")
    monkeypatch.setattr(trimesh, "load_scene", lambda *_, **__: scene)
    with pytest.raises(InputError, match="its scene has 120000000 vertices"):
        read_mesh(tmp_path / "a.glb")


def test_faces_of_vertices_that_are_not_there_are_refused(mesh, tmp_path):
    for corner in (5, -1):
        write_ply(mesh.replace(faces=torch.tensor([[0, 1, corner]])), tmp_path / "a.ply")
        with pytest.raises(InputError, match=r"corners of its faces reach from .*its 5 vertices"):
            read_mesh(tmp_path / "a.ply")


def test_normals_that_are_not_finite_are_dropped_and_the_rest_is_kept(mesh, tmp_path):
    normals = mesh.normals_world.clone()
    normals[3, 1] = torch.nan
    write_ply(mesh.replace(normals_world=normals), tmp_path / "a.ply")
    read = read_mesh(tmp_path / "a.ply")
    assert read.normals_world is None
    assert read.albedo is not None
    assert torch.equal(read.faces, mesh.faces)


def test_another_kind_of_file_is_refused_by_its_ending(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"ends in \.zip; needed: PLY, OBJ, STL, OFF or GLB"):
        read_mesh(tmp_path / "a.zip")


UTM = (448231.25, 5411923.5, 312.125)


def header_of(path):
    return path.read_bytes().partition(b"end_header")[0].decode().splitlines()


def fine_mesh(offset=(0.0, 0.0, 0.0), scale=1.0):
    vertices, faces = icosphere(4)
    return Mesh(
        vertices_world=scale * (vertices + torch.tensor(offset, dtype=torch.float64)), faces=faces
    )


@pytest.mark.parametrize("offset", [UTM, (4.2e6, 1.7e5, -4.78e6)])
@pytest.mark.parametrize(("write", "suffix"), [(write_ply, ".ply"), (write_glb, ".glb")])
def test_a_mesh_is_written_far_from_the_origin_without_losing_a_digit(
    write, suffix, offset, tmp_path
):
    mesh = fine_mesh()
    local = mesh.replace(vertices_world=mesh.vertices_world.float())
    write(local, tmp_path / f"a{suffix}", offset)
    read = read_mesh(tmp_path / f"a{suffix}")
    wanted = local.vertices_world.double() + torch.tensor(offset, dtype=torch.float64)
    assert_close(read.vertices_world, wanted, rtol=0, atol=2e-9)  # double precision at 5e6
    assert torch.equal(read.faces, local.faces)


def test_positions_are_doubles_only_where_singles_would_move_them(tmp_path):
    cases = [
        (fine_mesh(), (0.0, 0.0, 0.0), "float"),
        (fine_mesh(scale=1e-6), (0.0, 0.0, 0.0), "float"),
        (fine_mesh(scale=1e6), (0.0, 0.0, 0.0), "float"),
        (fine_mesh((20.0, 0, 0)), (0.0, 0.0, 0.0), "float"),
        (fine_mesh(UTM), (0.0, 0.0, 0.0), "double"),
        (fine_mesh(), UTM, "double"),
        (fine_mesh().replace(faces=torch.zeros(0, 3).long()), (0.0, 0.0, 0.0), "float"),
        (fine_mesh(UTM).replace(faces=torch.zeros(0, 3).long()), (0.0, 0.0, 0.0), "double"),
    ]
    for number, (mesh, offset, kind) in enumerate(cases):
        write_ply(mesh, tmp_path / "a.ply", offset)
        written = [line for line in header_of(tmp_path / "a.ply") if line.split()[-1] in "xyz"]
        assert written == [f"property {kind} {axis}" for axis in "xyz"], number
        read = read_mesh(tmp_path / "a.ply").vertices_world
        placed = mesh.vertices_world + torch.tensor(offset, dtype=torch.float64)
        extent = float((placed.amax(dim=0) - placed.amin(dim=0)).norm())
        assert float((read - placed).abs().max()) < 1e-6 * extent, number


def test_a_glb_has_its_offset_in_its_node_and_nothing_there_without_one(tmp_path):
    for offset, placed in ((UTM, [{"mesh": 0, "translation": list(UTM)}]), ((0.0,) * 3, None)):
        write_glb(fine_mesh(), tmp_path / "a.glb", offset)
        data = (tmp_path / "a.glb").read_bytes()
        (size,) = struct.unpack_from("<I", data, 12)
        tree = json.loads(data[20 : 20 + size])
        nodes = [{key: node[key] for key in node if key != "name"} for node in tree["nodes"]]
        assert [node for node in nodes if "translation" in node] == (placed or [])
        positions = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
        # Around the origin, as viewers want it; float32.
        assert max(map(abs, positions["max"])) <= 1 + 1e-6
        assert tree["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0
