import json
import struct
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scenes import ball
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.io.meshes import read_mesh, write_glb, write_mesh, write_ply
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError, OutputError


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
def test_a_mesh_survives_a_round_trip_through_its_file(mesh, write, suffix, tmp_path):
    write(mesh, tmp_path / f"mesh{suffix}")
    read = read_mesh(tmp_path / f"mesh{suffix}")
    assert_close(read.vertices_world, mesh.vertices_world, rtol=0, atol=1e-7)  # float32 files
    assert torch.equal(read.faces, mesh.faces)
    assert_close(read.normals_world, mesh.normals_world, rtol=0, atol=1e-6)
    # The PLY has 8 bits; sRGB is steepest at bright levels: 2.3 / 255 / 2.
    tolerance = 0.006 if suffix == ".ply" else 1e-6
    albedo = (mesh.albedo * albedo_scale(mesh)).clamp(0, 1)
    assert_close(read.albedo, albedo, rtol=0, atol=tolerance)
    if suffix == ".ply":
        assert_close(read.confidence, mesh.confidence, rtol=0, atol=1e-7)
        assert_close(read.expected_error, mesh.expected_error, rtol=0, atol=1e-7)


def parts_of(path):
    """Return the JSON and the binary data of a GLB."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def write_parts(path, tree, data):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = ((b"JSON", text), (b"BIN\0", data))
    body = b"".join(struct.pack("<I4s", len(one), kind) + one for kind, one in chunks)
    path.write_bytes(struct.pack("<4s2I", b"glTF", 2, 12 + len(body)) + body)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_all_colour_types_of_gltf_are_read(kind, mesh, tmp_path):
    path = tmp_path / "a.glb"
    write_glb(mesh, path)
    tree, data = parts_of(path)
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
    write_parts(path, tree, data + colors.tobytes())
    wanted = torch.from_numpy(colors[:, :3].astype(np.float64) / top)
    assert_close(read_mesh(path).albedo, wanted, rtol=0, atol=1e-12)


def test_transforms_of_scene_nodes_are_applied(tmp_path):
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
    assert int(read.faces[12:].min()) == len(box.vertices)  # the second part has its own vertices


def test_missing_normals_stay_missing(tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    read = read_mesh(tmp_path / "one.obj")
    assert (read.normals_world, read.albedo, read.confidence) == (None, None, None)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("normals", [True, False])
def test_a_point_cloud_has_no_faces_and_the_normals_of_its_file(tmp_path, text, normals):
    rows = np.array([[0.5, -0.25, 1.5, 0, 0.6, 0.8], [1, 2, 3, 0, 0, 2]], dtype="<f4")
    names = ("x", "y", "z", "nx", "ny", "nz")[: 6 if normals else 3]
    rows = rows[:, : len(names)].copy()
    lines = "".join(" ".join(str(value) for value in row) + "\n" for row in rows).encode()
    kind, body = ("ascii", lines) if text else ("binary_little_endian", rows.tobytes())
    properties = [f"property float {name}" for name in names]
    (tmp_path / "cloud.ply").write_bytes(ply("vertex", 2, properties, body, kind))
    cloud = read_mesh(tmp_path / "cloud.ply")
    assert cloud.faces.shape == (0, 3)
    assert_close(cloud.vertices_world, torch.from_numpy(rows[:, :3].astype(float)))
    if normals:
        wanted = torch.tensor([[0, 0.6, 0.8], [0, 0, 1]], dtype=torch.float64)
        assert_close(cloud.normals_world, wanted, rtol=0, atol=1e-6)
    else:
        assert cloud.normals_world is None


def ply(element, count, properties, body, kind="binary_little_endian"):
    lines = ["ply", f"format {kind} 1.0", f"element {element} {count}", *properties]
    return "\n".join([*lines, "end_header", ""]).encode() + body


XYZ = tuple(f"property float {axis}" for axis in "xyz")
FACES = ("property list uchar int vertex_indices",)
DAMAGED, MORE = "cannot be read as a mesh", "its header states|seems damaged|has no vertices"


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("none.ply", None, "found nothing"),
        ("mesh.zip", b"PK", r"its suffix is \.zip; needed: PLY, OBJ, STL, OFF or GLB"),
        ("mesh.pkl", b"cos\nsystem\n", DAMAGED),
        ("mesh.ply", b"not a mesh", DAMAGED),
        ("mesh.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("mesh.obj", b"# empty\n", "vertices|cannot be read"),
        ("a.ply", ply("vertex", 4, XYZ, bytes(36)), DAMAGED),
        ("a.ply", ply("vertex", 2**40, XYZ, bytes(36)), MORE),
        ("a.ply", ply("vertex", -3, XYZ, bytes(36)), MORE),
        ("a.ply", ply("face", 2**31, FACES, bytes(9)), MORE),
        ("a.ply", ply("vertex", 4, XYZ, b"0 0 0\n" * 3, "ascii"), MORE),
        ("a.ply", ply("vertex", 2**40, XYZ, b"0 0 0\n", "ascii"), MORE),
        ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), MORE),
    ],
)
def test_an_invalid_mesh_is_refused_without_allocation(name, content, why, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match=rf"{name}: .*({why})"):
        read_mesh(tmp_path / name)
    assert tracemalloc.get_traced_memory()[1] < 1e7
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda tree: tree["accessors"][0].update(count=2**40), "damaged"),
        (lambda tree: tree["accessors"][0].pop("bufferView"), "values are sparse or compressed"),
        (lambda tree: tree["bufferViews"][0].update(byteLength=2**40), "damaged"),
        (lambda tree: tree["accessors"][0].update(type="VEC9"), "damaged"),
    ],
)
def test_an_invalid_scene_graph_is_refused(mesh, change, why, tmp_path):
    write_glb(mesh, tmp_path / "a.glb")
    tree, data = parts_of(tmp_path / "a.glb")
    change(tree)
    write_parts(tmp_path / "a.glb", tree, data)
    with pytest.raises(InputError, match=why):
        read_mesh(tmp_path / "a.glb")


def test_a_scene_with_too_many_instances_is_refused(mesh, tmp_path, monkeypatch):
    class Graph(dict):
        nodes_geometry = ("first", "second")

    part = SimpleNamespace(vertices=range(60_000_000))
    graph = Graph.fromkeys(Graph.nodes_geometry, (np.eye(4), "part"))
    scene = SimpleNamespace(graph=graph, geometry={"part": part})
    write_glb(mesh, tmp_path / "a.glb")
    monkeypatch.setattr(trimesh, "load_scene", lambda *_, **__: scene)
    with pytest.raises(InputError, match="its scene has 120000000 vertices"):
        read_mesh(tmp_path / "a.glb")


def test_faces_with_missing_vertices_are_refused(mesh, tmp_path):
    for corner in (5, -1):
        write_ply(mesh.replace(faces=torch.tensor([[0, 1, corner]])), tmp_path / "a.ply")
        with pytest.raises(InputError, match=r"corners of its faces range from .*its 5 vertices"):
            read_mesh(tmp_path / "a.ply")


def test_normals_that_are_not_finite_are_dropped(mesh, tmp_path):
    normals = mesh.normals_world.clone()
    normals[3, 1] = torch.nan
    write_ply(mesh.replace(normals_world=normals), tmp_path / "a.ply")
    read = read_mesh(tmp_path / "a.ply")
    assert read.normals_world is None
    assert read.albedo is not None
    assert torch.equal(read.faces, mesh.faces)


UTM = (448231.25, 5411923.5, 312.125)
FINE = ball(level=4)


@pytest.mark.parametrize("offset", [UTM, (4.2e6, 1.7e5, -4.78e6)])
@pytest.mark.parametrize(("write", "suffix"), [(write_ply, ".ply"), (write_glb, ".glb")])
def test_far_from_the_origin_positions_keep_their_precision(write, suffix, offset, tmp_path):
    local = FINE.to(torch.float32)
    write(local, tmp_path / f"a{suffix}", offset)
    read = read_mesh(tmp_path / f"a{suffix}")
    wanted = local.vertices_world.double() + torch.tensor(offset, dtype=torch.float64)
    assert_close(read.vertices_world, wanted, rtol=0, atol=2e-9)  # double precision at 5e6
    assert torch.equal(read.faces, local.faces)


def without_faces(mesh):
    return mesh.replace(faces=torch.zeros(0, 3).long())


@pytest.mark.parametrize(
    ("mesh", "offset", "kind"),
    [
        (FINE, (0.0, 0.0, 0.0), "float"),
        (ball(1e-6, level=4), (0.0, 0.0, 0.0), "float"),
        (ball(1e6, level=4), (0.0, 0.0, 0.0), "float"),
        (ball(level=4, center=(20.0, 0, 0)), (0.0, 0.0, 0.0), "float"),
        (ball(level=4, center=UTM), (0.0, 0.0, 0.0), "double"),
        (FINE, UTM, "double"),
        (without_faces(FINE), (0.0, 0.0, 0.0), "float"),
        (without_faces(ball(level=4, center=UTM)), (0.0, 0.0, 0.0), "double"),
    ],
)
def test_positions_are_doubles_only_if_floats_would_round_them(tmp_path, mesh, offset, kind):
    write_ply(mesh, tmp_path / "a.ply", offset)
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    written = [line for line in header if line.split()[-1] in "xyz"]
    assert written == [f"property {kind} {axis}" for axis in "xyz"]
    read = read_mesh(tmp_path / "a.ply").vertices_world
    placed = mesh.vertices_world + torch.tensor(offset, dtype=torch.float64)
    extent = float((placed.amax(dim=0) - placed.amin(dim=0)).norm())
    assert float((read - placed).abs().max()) < 1e-6 * extent


def test_the_node_of_a_glb_has_the_offset_if_there_is_one(tmp_path):
    for offset, placed in ((UTM, [{"mesh": 0, "translation": list(UTM)}]), ((0.0,) * 3, None)):
        write_glb(FINE, tmp_path / "a.glb", offset)
        tree, _ = parts_of(tmp_path / "a.glb")
        nodes = [{key: node[key] for key in node if key != "name"} for node in tree["nodes"]]
        assert [node for node in nodes if "translation" in node] == (placed or [])
        positions = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
        # Around the origin, as viewers require; float32.
        assert max(map(abs, positions["max"])) <= 1 + 1e-6
        assert tree["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".OBJ", ".stl"])
def test_a_mesh_is_saved_as_it_is_in_the_format_of_its_suffix(mesh, suffix, tmp_path):
    path = tmp_path / "new" / f"mesh{suffix}"
    mesh.replace(vertices_world=mesh.vertices_world.requires_grad_()).save(path)
    read = read_mesh(path)
    corners = mesh.vertices_world.detach()[mesh.faces]
    assert_close(read.vertices_world[read.faces], corners, rtol=0, atol=1e-7)  # float32 files
    assert (read.albedo is None) == (suffix == ".stl")


def test_unwritable_meshes_and_files_are_refused(mesh, tmp_path):
    with pytest.raises(InputError, match=r"its suffix is '.xyz'; needed: one of .ply, .glb"):
        write_mesh(mesh, tmp_path / "mesh.xyz")
    wrong = mesh.replace(faces=mesh.faces + 3)
    with pytest.raises(InputError, match=r"mesh\.ply: Mesh.faces .*needed: indices of 5 vertices"):
        wrong.save(tmp_path / "mesh.ply")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="writing failed"):
        mesh.save(tmp_path / "file" / "mesh.ply")


def test_trimesh_gets_geometry_colours_and_errors(mesh):
    found = mesh.to_trimesh()
    assert (found.vertices == mesh.vertices_world.numpy()).all()
    assert (found.faces == mesh.faces.numpy()).all()
    assert_close(torch.tensor(found.vertex_normals), mesh.normals_world)
    colors = srgb_from_linear((mesh.albedo * albedo_scale(mesh)).clamp(0, 1))
    assert np.abs(found.visual.vertex_colors[:, :3] / 255 - colors.numpy()).max() <= 0.51 / 255
    assert (found.vertex_attributes["confidence"] == mesh.confidence.numpy()).all()
    bare = mesh.replace(albedo=None, confidence=None, expected_error=None).to_trimesh()
    assert not bare.vertex_attributes
