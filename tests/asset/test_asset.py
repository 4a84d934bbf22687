import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch.nn.functional import grid_sample, normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.doors.io.meshes import write_glb
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.radiometry import linear_from_srgb, srgb_from_linear
from pimper_torch.records import Mesh, Textured
from pimper_torch.result.asset import atlas as atlases
from pimper_torch.result.asset.atlas import MAX_SIDE, by_triangles, unwrapped
from pimper_torch.result.asset.bake import baked
from pimper_torch.result.asset.make import textured
from pimper_torch.result.asset.tangents import tangents
from pimper_torch.result.asset.write import write_asset, write_asset_obj
from pimper_torch.result.viz.maps import base_color
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.runtime.parallel import on_one_thread


def ball(level: int) -> Mesh:
    """A sphere that carries other normals than its shape has, and a smooth albedo."""
    vertices, faces = icosphere(level)
    vertices = vertices.float()
    bumps = torch.stack([torch.sin(9 * vertices[:, 1]), torch.cos(7 * vertices[:, 2])], dim=1)
    tilted = vertices + 0.2 * torch.cat([bumps, bumps[:, :1] * bumps[:, 1:]], dim=1)
    return Mesh(
        vertices_world=vertices,
        faces=faces,
        normals_world=normalize(tilted, dim=1),
        albedo=0.5 + 0.3 * torch.sin(5 * vertices),
        confidence=0.5 + 0.5 * vertices[:, 0].abs(),
        expected_error=0.01 + 0.001 * vertices[:, 2],
    )


@pytest.fixture(scope="module")
def full() -> Mesh:
    return ball(5)


@pytest.fixture(scope="module")
def few() -> Mesh:
    return ball(3)


@pytest.fixture(scope="module")
def asset(full, few) -> Textured:
    return textured(full, few)


def sampled(picture, uv):
    """A texture between texels, as graphics cards blend it."""
    planes = picture.float().movedim(-1, 0)[None]
    found = grid_sample(planes, 2 * uv[None, None] - 1, align_corners=False, padding_mode="border")
    return found[0, :, 0].T


def seen(asset: Textured, count: int = 50_000):
    """Points on every part of the asset, with normals and base colours as three.js draws them."""
    random = torch.Generator().manual_seed(1)
    face = torch.randint(len(asset.mesh.faces), (count,), generator=random)
    weights = torch.rand(count, 3, generator=random)
    weights = weights / weights.sum(dim=1, keepdim=True)

    def blended(values):
        return (weights[..., None] * values[asset.mesh.faces[face]]).sum(dim=1)

    normal, tangent = blended(asset.normals), blended(asset.tangent[:, :3])
    sign = asset.tangent[asset.mesh.faces[face, 0], 3:]
    bitangent = sign * torch.linalg.cross(normal, tangent)
    mapped = 2 * sampled(asset.normal, blended(asset.uv)) / 255 - 1
    axes = [normalize(axis, dim=1) for axis in (tangent, bitangent, normal)]
    shown = sum(mapped[:, [axis]] * axes[axis] for axis in range(3))
    color = sampled(asset.base_color, blended(asset.uv))
    return blended(asset.mesh.vertices_world), normalize(shown, dim=1), color


def angles_deg(one, other):
    return torch.rad2deg(2 * torch.asin(((one - other).norm(dim=1) / 2).clamp_max(1)))


def of_surface(full: Mesh, points):
    """Carried normals and base colours where rays from the ball's centre meet it."""
    hits = RayCaster(full.vertices_world, full.faces).cast(torch.zeros(3), normalize(points, dim=1))
    normals = normalize(hits.interpolate(full.normals_world, full.faces), dim=1)
    return normals, hits.interpolate(base_color(full), full.faces)


@pytest.mark.parametrize("packed", ["xatlas", "triangles"])
def test_normals_and_albedo_are_those_of_the_surface(full, few, asset, packed):
    if packed == "triangles":
        asset = baked(full, few, by_triangles(few, 0.008))
    points, normals, color = seen(asset)
    wanted, albedo = of_surface(full, points)
    assert angles_deg(wanted, of_surface(few, points)[0]).max() > 2  # the vertices do not tell it
    assert angles_deg(normals, wanted).max() < 1.0
    assert (color - 255 * srgb_from_linear(albedo)).abs().max() < 1


def test_the_number_of_threads_changes_no_bit(full, few, asset):
    with on_one_thread():
        again = textured(full, few)
    assert torch.equal(again.normal, asset.normal)
    assert torch.equal(again.uv, asset.uv)
    assert torch.equal(again.base_color, asset.base_color)


@pytest.mark.parametrize("packed", ["xatlas", "triangles"])
def test_no_two_faces_share_a_texel(few, packed):
    atlas = (unwrapped if packed == "xatlas" else by_triangles)(few, 0.01)
    assert_close(few.faces, atlas.vertex[atlas.faces])
    assert atlas.uv.min() >= 0
    assert atlas.uv.max() <= 1
    size = atlas.uv.new_tensor([atlas.width, atlas.height])
    corners = (atlas.uv * size)[atlas.faces]
    random = torch.Generator().manual_seed(2)
    weights = torch.rand(len(corners), 20, 3, generator=random) + 0.01
    weights = weights / weights.sum(dim=2, keepdim=True)
    inside = torch.einsum("fsk,fkc->fsc", weights, corners)
    flat = torch.cat([atlas.uv * size, torch.zeros(len(atlas.uv), 1)], dim=1)
    start = torch.cat([inside, torch.full_like(inside[..., :1], -1.0)], dim=2)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(start)
    met = RayCaster(flat, atlas.faces).cast(start, up).face
    assert torch.equal(met, torch.arange(len(corners))[:, None].expand_as(met))
    sides = (corners - corners.roll(1, dims=1)).norm(dim=2)
    lengths = few.vertices_world[few.faces]
    lengths = (lengths - lengths.roll(1, dims=1)).norm(dim=2) / 0.01
    if packed == "xatlas":  # a texel is as large as it was asked for
        assert sides.mean() == pytest.approx(float(lengths.mean()), rel=0.15)
        assert atlas.charts < 100


@pytest.mark.parametrize("why", ["timed out", "No such file", "No module named"])
def test_every_face_is_a_chart_where_xatlas_fails(few, monkeypatch, why):
    if why == "timed out":
        monkeypatch.setattr(atlases, "_LIMIT_S", 0.01)
    elif why == "No such file":
        monkeypatch.setattr(atlases.sys, "executable", "/nowhere/python")
    else:  # sought where the package is not installed
        monkeypatch.setattr(atlases, "_CHILD", ("-P", "-S"))
        monkeypatch.delenv("PYTHONPATH", raising=False)
    with pytest.warns(PimperWarning, match=f"xatlas made no atlas .*{why}"):
        assert unwrapped(few, 0.01).charts == len(few.faces)


def test_a_texture_is_never_larger_than_browsers_take(few):
    for atlas in (unwrapped(few, 0.001), by_triangles(few, 0.0001)):
        assert max(atlas.width, atlas.height) in range(MAX_SIDE - 100, MAX_SIDE + 1)


def test_tangents_follow_the_texture_and_their_signs_its_mirror_images():
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    up, faces = torch.tensor([[0.0, 0, 1]]).expand(4, 3), torch.tensor([[0, 1, 2], [0, 2, 3]])
    uv = square[:, :2] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    assert_close(tangents(square, up, uv, faces), torch.tensor([[1.0, 0, 0, 1]]).expand(4, 4))
    mirrored = uv * torch.tensor([-1.0, 1.0]) + torch.tensor([1.0, 0.0])
    wanted = torch.tensor([[-1.0, 0, 0, -1]]).expand(4, 4)
    assert_close(tangents(square, up, mirrored, faces), wanted)
    lost = tangents(square, up, torch.zeros(4, 2), faces)
    assert_close(lost[:, :3].norm(dim=1), torch.ones(4))
    assert_close(lost[:, 2], torch.zeros(4))


def validated(path: Path) -> list[dict[str, object]]:
    """Errors and warnings of Khronos' validator: the folder of the npm package gltf-validator."""
    folder = os.environ.get("PIMPER_GLTF_VALIDATOR")
    node = shutil.which("node")
    if not (folder and node):
        pytest.skip("needs node, and PIMPER_GLTF_VALIDATOR: the folder of npm's gltf-validator")
    program = (
        f"require({json.dumps(str(Path(folder) / 'index.js'))}).validateBytes("
        f"new Uint8Array(require('fs').readFileSync({json.dumps(str(path))})))"
        ".then((report) => console.log(JSON.stringify(report.issues.messages)))"
    )
    ran = subprocess.run([node, "-e", program], capture_output=True, text=True, check=True)
    return [issue for issue in json.loads(ran.stdout) if issue["severity"] < 2]


OFFSET = (448231.0, 5411923.0, 312.0)


def test_the_glb_is_clean_and_says_what_was_baked(asset, tmp_path):
    path = tmp_path / "asset.glb"
    write_asset(asset, path, OFFSET)
    scene = trimesh.load_scene(path, process=False)
    (shape,) = scene.geometry.values()
    mesh = asset.mesh
    assert np.allclose(shape.vertices, mesh.vertices_world)
    assert np.array_equal(shape.faces, mesh.faces)
    placed = scene.graph[scene.graph.nodes_geometry[0]][0]
    assert placed[:3, 3] == pytest.approx(OFFSET)
    told = shape.vertex_attributes
    assert np.allclose(np.ravel(told["_EXPECTED_ERROR"]), mesh.expected_error)
    assert np.allclose(np.ravel(told["_SUPPORT"]), mesh.confidence)
    material = shape.visual.material
    assert np.array_equal(np.asarray(material.baseColorTexture), asset.base_color)
    assert np.array_equal(np.asarray(material.normalTexture), asset.normal)
    assert (material.metallicFactor, material.roughnessFactor) == (0, 1)
    # Trimesh has v up.
    assert np.allclose(shape.visual.uv * [1, -1] + [0, 1], asset.uv, atol=1e-6)
    assert validated(path) == []


def test_the_meshs_glb_is_clean(full, tmp_path):
    write_glb(full, tmp_path / "mesh.glb", OFFSET)
    assert validated(tmp_path / "mesh.glb") == []


@pytest.mark.parametrize("clusters", [1, 2])
def test_materials_are_factors_or_textures_where_they_differ(full, few, tmp_path, clusters):
    known = torch.tensor([[0.0, 0.3, 0.5], [1.0, 0.6, 2.0]])
    cluster = (few.vertices_world[:, 0] > 0).long() * (clusters - 1)
    reflectance = known[cluster]
    asset = textured(full, few, reflectance)
    path = tmp_path / "asset.glb"
    write_asset(asset, path)
    raw = path.read_bytes()
    tree = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
    (material,) = tree["materials"]
    surface, gloss = material["pbrMetallicRoughness"], material["extensions"]
    gloss = gloss["KHR_materials_specular"]
    assert tree["extensionsUsed"] == ["KHR_materials_specular"]
    if clusters == 1:
        assert (surface["metallicFactor"], surface["roughnessFactor"]) == pytest.approx((0, 0.3))
        assert gloss == {"specularFactor": pytest.approx(0.5), "specularColorFactor": [1.0] * 3}
        assert len(tree["images"]) == 2
    else:
        view = [tree["bufferViews"][tree["images"][image]["bufferView"]] for image in (2, 3)]
        start = 28 + int.from_bytes(raw[12:16], "little")
        pictures = []
        for one in view:
            at = start + one["byteOffset"]
            (tmp_path / "a.png").write_bytes(raw[at : at + one["byteLength"]])
            pictures.append(torch.from_numpy(np.array(Image.open(tmp_path / "a.png"))).float())
        corners = asset.uv[asset.mesh.faces]
        centre, x = corners.mean(dim=1), asset.mesh.vertices_world[asset.mesh.faces][..., 0]
        rough, gloss_texture = (sampled(picture, centre) / 255 for picture in pictures)
        strength = gloss_texture[:, 3] * linear_from_srgb(gloss_texture[:, 0])
        strength = strength * gloss["specularColorFactor"][0]
        for sign, wanted in ((-1, known[0]), (1, known[1])):
            some = (sign * x > 0.05).all(dim=1)
            assert_close(rough[some, 2], wanted[0].expand(some.sum()), atol=0.003, rtol=0)
            assert_close(rough[some, 1], wanted[1].expand(some.sum()), atol=0.003, rtol=0)
            assert_close(strength[some], wanted[2].expand(some.sum()), atol=0.02, rtol=0)
    assert validated(path) == []


def test_the_obj_refers_to_its_textures(asset, tmp_path):
    write_asset_obj(asset, tmp_path / "asset.obj")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"asset.obj", "asset.mtl", "asset_albedo.png", "asset_normal.png"}
    shape = trimesh.load(tmp_path / "asset.obj", process=False, maintain_order=True)
    corners = asset.mesh.vertices_world[asset.mesh.faces]
    assert np.allclose(shape.vertices[shape.faces], corners, atol=1e-6)
    upward = (asset.uv * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0]))[asset.mesh.faces]
    assert np.allclose(shape.visual.uv[shape.faces], upward, atol=1e-6)
    assert np.array_equal(np.asarray(shape.visual.material.image), asset.base_color)
