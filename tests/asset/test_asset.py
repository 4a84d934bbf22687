import io
import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch.nn.functional import grid_sample, normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.rigid import rotate, transform
from pimper_torch.geometry.tangents import vertex_tangents
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.io.assets.placement import Placement, standing
from pimper_torch.io.assets.write import write_asset, write_asset_obj
from pimper_torch.io.meshes import write_glb
from pimper_torch.radiometry import linear_from_srgb, srgb_from_linear
from pimper_torch.radiometry.base_color import base_color
from pimper_torch.records import Cameras, Mesh, TexturedMesh
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.runtime.parallel import on_one_thread
from pimper_torch.stages.texturing import atlas as atlases
from pimper_torch.stages.texturing.atlas import MAX_SIDE, by_triangles, unwrapped
from pimper_torch.stages.texturing.bake import textured
from pimper_torch.stages.texturing.inpaint import inpainted


def ball(level: int) -> Mesh:
    """A sphere with normals that differ from its shape, and a smooth albedo."""
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
def asset(full, few) -> TexturedMesh:
    return textured(full, few)


def sampled(picture, uv):
    """Sample a texture by bilinear interpolation, as graphics cards do."""
    planes = picture.float().movedim(-1, 0)[None]
    found = grid_sample(planes, 2 * uv[None, None] - 1, align_corners=False, padding_mode="border")
    return found[0, :, 0].T


def seen(asset: TexturedMesh, count: int = 50_000):
    """Return points all over the asset, with normals and base colours as drawn by three.js."""
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
    """Return attached normals and base colours where rays from the centre hit the ball."""
    hits = RayCaster(full.vertices_world, full.faces).cast(torch.zeros(3), normalize(points, dim=1))
    normals = normalize(hits.interpolate(full.normals_world, full.faces), dim=1)
    return normals, hits.interpolate(base_color(full), full.faces)


@pytest.mark.parametrize("packed", ["xatlas", "triangles"])
def test_baked_normals_and_albedo_equal_those_of_the_surface(full, few, asset, packed):
    if packed == "triangles":
        asset = textured(full, few, atlas=by_triangles(few, 0.008))
    points, normals, color = seen(asset)
    wanted, albedo = of_surface(full, points)
    assert angles_deg(wanted, of_surface(few, points)[0]).max() > 2  # vertices alone do not give it
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
    for side in (atlas.width, atlas.height):
        assert side.bit_count() == 1  # a power of two
    if packed == "xatlas":  # texels have the requested size, up to the nearest power
        assert 1 / 1.5 < float(sides.mean() / lengths.mean()) < 1.5
        assert atlas.charts < 100


@pytest.mark.parametrize("why", ["timed out", "No such file", "No module named"])
def test_every_face_is_a_chart_if_xatlas_fails(few, monkeypatch, why):
    if why == "timed out":
        monkeypatch.setattr(atlases, "_LIMIT_S", 0.01)
    elif why == "No such file":
        monkeypatch.setattr(atlases.sys, "executable", "/nowhere/python")
    else:  # the package is not installed
        monkeypatch.setattr(atlases, "_CHILD", ("-P", "-S"))
        monkeypatch.delenv("PYTHONPATH", raising=False)
    with pytest.warns(PimperWarning, match=f"xatlas failed to unwrap the surface .*{why}"):
        assert unwrapped(few, 0.01).charts == len(few.faces)


def test_texture_size_is_limited_to_that_of_browsers(few):
    for atlas in (unwrapped(few, 0.001), by_triangles(few, 0.0001)):
        assert max(atlas.width, atlas.height) == MAX_SIDE


def test_tangents_follow_the_texture_and_mark_mirrored_charts():
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    up, faces = torch.tensor([[0.0, 0, 1]]).expand(4, 3), torch.tensor([[0, 1, 2], [0, 2, 3]])
    uv = square[:, :2] * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    assert_close(
        vertex_tangents(square, up, uv, faces), torch.tensor([[1.0, 0, 0, 1]]).expand(4, 4)
    )
    mirrored = uv * torch.tensor([-1.0, 1.0]) + torch.tensor([1.0, 0.0])
    wanted = torch.tensor([[-1.0, 0, 0, -1]]).expand(4, 4)
    assert_close(vertex_tangents(square, up, mirrored, faces), wanted)
    lost = vertex_tangents(square, up, torch.zeros(4, 2), faces)
    assert_close(lost[:, :3].norm(dim=1), torch.ones(4))
    assert_close(lost[:, 2], torch.zeros(4))


def validated(path: Path) -> list[dict[str, object]]:
    """Return errors and warnings of Khronos' validator, the npm package gltf-validator."""
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


def tree_of(path: Path) -> dict:
    raw = path.read_bytes()
    return json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])


def picture_in(path: Path, image: int) -> np.ndarray:
    """Return a picture of a GLB."""
    raw, tree = path.read_bytes(), tree_of(path)
    view = tree["bufferViews"][tree["images"][image]["bufferView"]]
    start = 28 + int.from_bytes(raw[12:16], "little") + view["byteOffset"]
    with Image.open(io.BytesIO(raw[start : start + view["byteLength"]])) as picture:
        return np.array(picture)


@pytest.fixture
def two_cameras(full) -> Cameras:
    """Two cameras that look at the ball, horizontally and from above; z is up."""
    up = torch.tensor([[0.0, 0, 1], [1.0, 0, 0]])
    poses = look_at(torch.tensor([[0.0, 9, 0], [0.0, 0, 9]]), torch.zeros(3), up)
    return pinholes(poses, 500.0, 640, 480)


@pytest.fixture
def placement(asset, two_cameras) -> Placement:
    up = torch.tensor([0.0, 0, 1])
    return Placement(
        name="my skull",
        scene_from_asset=standing(asset.mesh, two_cameras, 0, up, 10.0),
        offset_world=OFFSET,
        metric=True,
        cameras=(("one.jpg", "two.jpg"), two_cameras),
    )


@pytest.mark.parametrize("texture", ["png", "jpeg", "webp"])
def test_the_glb_is_valid_and_has_the_baked_textures(asset, placement, tmp_path, texture):
    path = tmp_path / "asset.glb"
    write_asset(asset, path, placement, texture)
    scene = trimesh.load_scene(path, process=False)
    (shape,) = scene.geometry.values()
    mesh, tree = asset.mesh, tree_of(path)
    assert np.array_equal(shape.faces, mesh.faces)
    for kind in ("nodes", "meshes", "materials"):
        assert tree[kind][0]["name"] == "my skull"
    extras = tree["nodes"][0]["extras"]
    back = torch.tensor(extras["scene_from_asset"]).reshape(4, 4).mT
    vertices = transform(back, torch.tensor(shape.vertices).float())
    assert_close(vertices, mesh.vertices_world, atol=1e-6, rtol=0)
    assert extras["offset_world"] == list(OFFSET)
    normals = normalize(rotate(back, torch.tensor(shape.vertex_normals).float()), dim=1)
    assert_close(normals, asset.normals, atol=1e-6, rtol=0)
    attributes = shape.vertex_attributes
    assert np.allclose(np.ravel(attributes["_EXPECTED_ERROR"]), mesh.expected_error)
    assert np.allclose(np.ravel(attributes["_SUPPORT"]), mesh.confidence)
    material = shape.visual.material
    color, bumps = material.baseColorTexture, material.normalTexture
    away = torch.tensor(np.asarray(color)).float() - asset.base_color
    # Charts of different colours meet in this small image: 2 and 4 levels.
    assert away.square().mean().sqrt() <= (0 if texture == "png" else 5)
    assert np.array_equal(np.asarray(bumps), asset.normal)  # directions are stored losslessly
    kinds = (texture.upper(), "WEBP" if texture == "webp" else "PNG")
    assert (color.format, bumps.format) == kinds
    assert (material.metallicFactor, material.roughnessFactor) == (0, 1)
    # v is up in trimesh.
    assert np.allclose(shape.visual.uv * [1, -1] + [0, 1], asset.uv, atol=1e-6)
    assert validated(path) == []


def test_an_asset_is_at_the_origin_and_faces_the_reference_camera(asset, two_cameras, placement):
    """A ball of radius 1 with z up, ten units per metre; a bump marks the front."""
    vertices, _ = placement.placed(asset.mesh.vertices_world, asset.normals)
    low, high = vertices.aminmax(dim=0)
    assert_close(low, torch.tensor([-0.1, 0.0, -0.1]), atol=2e-3, rtol=0)
    assert_close(high, torch.tensor([0.1, 0.2, 0.1]), atol=2e-3, rtol=0)
    marks = torch.tensor([[0.0, 1, 0], [0, 0, 1]])  # towards the first camera, and up
    for reference, front in ((0, [0.0, 0.1, 0.1]), (1, [-0.1, 0.1, 0.0])):
        matrix = standing(asset.mesh, two_cameras, reference, marks[1], 10.0)
        placed = replace(placement, scene_from_asset=matrix).placed(marks, marks)[0]
        assert_close(placed[1], torch.tensor([0.0, 0.2, 0.0]), atol=2e-3, rtol=0)
        # From above, the image's upper edge is at x, and the front is opposite.
        assert_close(placed[0], torch.tensor(front), atol=2e-3, rtol=0)
    unknown = standing(asset.mesh, two_cameras, 0, marks[1], None)
    vertices, _ = replace(placement, scene_from_asset=unknown).placed(
        asset.mesh.vertices_world, asset.normals
    )
    assert float((vertices.amax(dim=0) - vertices.amin(dim=0)).max()) == pytest.approx(1)


def test_cameras_in_the_glb_agree_with_the_photographs(asset, two_cameras, placement, tmp_path):
    """Cameras in glTF look along -z, with y up."""
    write_asset(asset, tmp_path / "asset.glb", placement)
    tree = tree_of(tmp_path / "asset.glb")
    assert tree["scenes"] == [{"nodes": [0, 1, 2]}]
    point = torch.tensor([[0.3, 0.2, -0.4]])
    there = placement.placed(point, point)[0].double()
    for view, node in enumerate(tree["nodes"][1:]):
        assert node["name"] == ("one.jpg", "two.jpg")[view]
        lens = tree["cameras"][node["camera"]]["perspective"]
        seen = transform(torch.tensor(node["matrix"]).reshape(4, 4).mT.double().inverse(), there)[0]
        focal = 1 / np.tan(lens["yfov"] / 2)
        found = focal / -seen[2] * seen[:2] / torch.tensor([lens["aspectRatio"], 1.0])
        pixel = two_cameras.intrinsics[view] @ transform(two_cameras.cam_from_world[view], point)[0]
        wanted = (pixel[:2] / pixel[2] / torch.tensor([320.0, 240.0]) - 1) * torch.tensor([1, -1.0])
        assert_close(found.float(), wanted, atol=1e-5, rtol=0)


def test_implausibly_bright_albedo_is_inpainted_and_marked(full, few):
    """A cap of the ball is unlit, except for an implausibly bright speck."""
    z = full.vertices_world[:, 2]
    confidence = (z < 0.5).float()
    speck = (full.vertices_world[:, 0] > 0.4) & (z > 0.6)
    albedo = torch.where((z < 0.5)[:, None], full.albedo, 0.3)
    glowing = full.replace(albedo=torch.where(speck[:, None], 4.0, albedo), confidence=confidence)
    made = inpainted(glowing)[0].albedo
    assert made[speck].max() <= albedo.max()
    assert torch.equal(made[~speck], albedo[~speck])
    asset = textured(glowing, few)
    points, _, uncertainty = seen(
        asset.replace(base_color=asset.uncertainty[..., None].expand(-1, -1, 3))
    )
    inside = (points[:, 0] > 0.45) & (points[:, 2] > 0.65)
    lit = points[:, 2] < 0.4
    plain = (points[:, 0] < 0.3) & (points[:, 2] > 0.6)
    for where, level in ((inside, 255), (plain, 128), (lit, 0)):
        assert_close(uncertainty[where], torch.full_like(uncertainty[where], level), atol=1, rtol=0)
    dim = glowing.replace(albedo=albedo)
    assert torch.equal(inpainted(dim)[0].albedo, albedo)
    none = full.replace(confidence=torch.zeros_like(z))
    assert torch.equal(inpainted(none)[0].albedo, full.albedo)


def test_the_mask_of_unreliable_albedo_is_a_texture_of_the_glb(full, few, asset, tmp_path):
    assert not asset.uncertainty.any()
    doubtful = asset.replace(uncertainty=torch.full_like(asset.uncertainty, 128))
    for one, name in ((asset, "sure"), (doubtful, "doubtful")):
        write_asset(one, tmp_path / f"{name}.glb")
        assert validated(tmp_path / f"{name}.glb") == []
    assert "extras" not in tree_of(tmp_path / "sure.glb")["materials"][0]
    tree = tree_of(tmp_path / "doubtful.glb")
    texture = tree["materials"][0]["extras"]["albedo_uncertainty"]["index"]
    mask = picture_in(tmp_path / "doubtful.glb", tree["textures"][texture]["source"])
    assert np.array_equal(mask, doubtful.uncertainty)


def test_the_glb_of_a_mesh_is_valid(full, tmp_path):
    write_glb(full, tmp_path / "mesh.glb", OFFSET)
    assert validated(tmp_path / "mesh.glb") == []


@pytest.mark.parametrize("clusters", [1, 2])
def test_materials_are_factors_or_textures(full, few, tmp_path, clusters):
    known = torch.tensor([[0.0, 0.3, 0.5], [1.0, 0.6, 2.0]])
    cluster = (few.vertices_world[:, 0] > 0).long() * (clusters - 1)
    reflectance = known[cluster]
    asset = textured(full, few, reflectance)
    path = tmp_path / "asset.glb"
    write_asset(asset, path)
    tree = tree_of(path)
    (material,) = tree["materials"]
    surface, gloss = material["pbrMetallicRoughness"], material["extensions"]
    gloss = gloss["KHR_materials_specular"]
    assert tree["extensionsUsed"] == ["KHR_materials_specular"]
    if clusters == 1:
        assert (surface["metallicFactor"], surface["roughnessFactor"]) == pytest.approx((0, 0.3))
        assert gloss == {"specularFactor": pytest.approx(0.5), "specularColorFactor": [1.0] * 3}
        assert len(tree["images"]) == 2
    else:
        pictures = [torch.from_numpy(picture_in(path, image)).float() for image in (2, 3)]
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


def test_the_obj_refers_to_its_textures(asset, placement, tmp_path):
    write_asset_obj(asset, tmp_path / "asset.obj", placement)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"asset.obj", "asset.mtl", "asset_albedo.png", "asset_normal.png"}
    shape = trimesh.load(tmp_path / "asset.obj", process=False, maintain_order=True)
    vertices, _ = placement.placed(asset.mesh.vertices_world, asset.normals)
    assert np.allclose(shape.vertices[shape.faces], vertices[asset.mesh.faces], atol=1e-6)
    assert (tmp_path / "asset.obj").read_text().startswith("# scene_from_asset: [-10.0, ")
    upward = (asset.uv * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0]))[asset.mesh.faces]
    assert np.allclose(shape.visual.uv[shape.faces], upward, atol=1e-6)
    assert np.array_equal(np.asarray(shape.visual.material.image), asset.base_color)
