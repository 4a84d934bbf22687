import re

import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from pimper_torch.camera_files.conventions import camera_mistakes
from pimper_torch.evidence.datasets.check import check_capture
from pimper_torch.evidence.metrics.sampling import sample_surface
from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.geometry.frames import invert_rigid, rigid
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import cast_view
from pimper_torch.records import Cameras, Capture, Mesh, Truth, Views

WIDTH, HEIGHT, NUM_VIEWS = 120, 90, 6


def lump(seed: int = 0) -> Mesh:
    """Make a closed, lopsided body, the same from no two sides."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    points = torch.tensor(ball.vertices, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    waves = 2.2 * torch.randn(9, 3, generator=generator, dtype=torch.float64)
    phases = 6 * torch.rand(9, generator=generator, dtype=torch.float64)
    radius = 1 + 0.07 * (points @ waves.T + phases).sin().sum(dim=1)
    vertices = radius[:, None] * points * points.new_tensor([1.0, 0.75, 0.6])
    vertices = vertices + points.new_tensor([0.15, 0.2, 0.0])  # off the cameras' axes
    faces = torch.tensor(ball.faces, dtype=torch.long)
    return Mesh(vertices_world=vertices, faces=faces, normals_world=vertex_normals(vertices, faces))


def speckle(points: torch.Tensor) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    waves = 14 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    phases = 6 * torch.rand(24, generator=generator, dtype=torch.float64)
    return 0.5 + 0.4 * torch.tanh((points @ waves.T + phases).sin().sum(dim=-1))


def photograph(mesh: Mesh, cameras: Cameras, lights: torch.Tensor) -> Capture:
    depths, normals, images, albedos = [], [], [], []
    assert mesh.normals_world is not None
    for view in range(cameras.num_views):
        hits = cast_view(mesh, cameras, view)
        normal = normalize(hits.interpolate(mesh.normals_world, mesh.faces), dim=-1)
        points = hits.interpolate(mesh.vertices_world, mesh.faces)
        albedo = speckle(points) * hits.distance.isfinite()
        shading = (lights[view, 0] + normal @ lights[view, 1:]).clamp_min(0)
        depths.append(hits.distance)
        normals.append(normal)
        albedos.append(albedo[..., None])
        images.append((albedo * shading)[None].expand(3, -1, -1))
    depth = torch.stack(depths)
    views = Views(
        images=torch.stack(images).float(),
        sizes_px=cameras.sizes_px,
        names=tuple(f"{view}.png" for view in range(cameras.num_views)),
        masks=depth.isfinite(),
        focals_px=torch.full((cameras.num_views,), torch.nan),
    )
    return Capture(
        views=views,
        cameras=cameras,
        truth=Truth(
            mesh=mesh,
            depth=depth.float(),
            normals_world=torch.stack(normals).float(),
            albedo=torch.stack(albedos).float(),
            lights_world=lights.float(),
        ),
        position=torch.arange(cameras.num_views),
        light=torch.arange(cameras.num_views),
    )


@pytest.fixture(scope="module")
def whole():
    """Six photographs with everything known about them."""
    cameras = arc_cameras(
        NUM_VIEWS,
        width=WIDTH,
        height=HEIGHT,
        focal_px=150.0,
        distance=4.5,
        span_deg=70.0,
        elevation_deg=20.0,
        sway_deg=8.0,
        front=(0.3, 0.0, 1.0),
    )
    eyes = normalize(cameras.centers_world, dim=1)
    generator = torch.Generator().manual_seed(2)
    aside = 0.6 * torch.randn(NUM_VIEWS, 3, generator=generator, dtype=torch.float64)
    lights = torch.cat(
        [torch.full((NUM_VIEWS, 1), 0.1).double(), 0.8 * normalize(eyes + aside, dim=1)], dim=1
    )
    return photograph(lump(), cameras, lights)


@pytest.fixture(scope="module")
def detailed():
    """Three larger photographs, close together, of which nothing else is known."""
    cameras = arc_cameras(
        3, width=280, height=210, focal_px=350.0, distance=4.5, span_deg=24.0, elevation_deg=20.0
    )
    lights = torch.tensor(
        [[0.1, 0.3, 0.2, 0.7], [0.3, -0.2, 0.3, 0.5], [0.1, 0.1, 0.5, 0.6]], dtype=torch.float64
    )
    capture = photograph(lump(), cameras, lights)
    return blind(without_masks(capture))


def flipped(x: int, y: int, z: int) -> torch.Tensor:
    return torch.diag(torch.tensor([x, y, z, 1.0], dtype=torch.float64))


def with_center(pose: torch.Tensor) -> torch.Tensor:
    return rigid(pose[:, :3, :3], -(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0])


# What was done to the right cameras; written out here, not taken from the package's undo.
POSES = {
    "world_from_cam": invert_rigid,
    "opengl_axes": lambda pose: flipped(1, -1, -1) @ pose,
    "world_from_cam_opengl": lambda pose: invert_rigid(pose) @ flipped(1, -1, -1),
    "transposed_rotation": lambda pose: rigid(pose[:, :3, :3].mT, pose[:, :3, 3]),
    "center_for_translation": with_center,
    "photographs_rotated": lambda pose: flipped(-1, -1, 1) @ pose,
    "world_axes_flipped": lambda pose: pose @ flipped(1, -1, -1),
}


def with_intrinsics(capture: Capture, factor: float) -> Capture:
    K = capture.cameras.intrinsics.clone()
    K[:, :2] *= factor
    return capture.replace(cameras=capture.cameras.replace(intrinsics=K))


def with_pose(capture: Capture, name: str) -> Capture:
    pose = POSES[name](capture.cameras.cam_from_world)
    return capture.replace(cameras=capture.cameras.replace(cam_from_world=pose))


def blind(capture: Capture, **known: object) -> Capture:
    """Leave only part of what is known."""
    return capture.replace(truth=Truth(**known))


def without_masks(capture: Capture) -> Capture:
    return capture.replace(views=capture.views.replace(masks=None))


EVIDENCE = {
    "mesh and masks": lambda capture: blind(capture, mesh=capture.truth.mesh),
    "points and masks": lambda capture: blind(
        capture,
        points_world=sample_surface(
            capture.truth.mesh, 5000, torch.Generator().manual_seed(1)
        ).points,
    ),
    "everything": lambda capture: capture,
}


def names(capture: Capture) -> list[str]:
    return [finding.name for finding in check_capture(capture).findings]


def test_every_pose_mistake_the_package_knows_is_tried_here(whole):
    assert {mistake.name for mistake in camera_mistakes(whole.cameras)} == set(POSES)


@pytest.mark.parametrize("evidence", EVIDENCE)
def test_a_right_capture_has_no_mistake(whole, evidence):
    report = check_capture(EVIDENCE[evidence](whole))
    assert report.findings == ()
    assert report.tested  # or it looked at nothing


# Each evidence is tried quickly on some mistakes and on all of them when there is time.
QUICK = {
    "mesh and masks": {
        "world_from_cam",
        "world_from_cam_opengl",
        "opengl_axes",
        "center_for_translation",
        "photographs_rotated",
    },
    "points and masks": {"world_axes_flipped", "transposed_rotation"},
    "everything": set(),
}
TOLD = [
    pytest.param(
        name,
        evidence,
        marks=[] if name in QUICK[evidence] else [pytest.mark.slow],
    )
    for name in POSES
    for evidence in EVIDENCE
]


@pytest.mark.parametrize(("name", "evidence"), TOLD)
def test_a_pose_mistake_is_named_whatever_tells_it(whole, name, evidence):
    (finding,) = check_capture(with_pose(EVIDENCE[evidence](whole), name)).findings
    assert finding.name == name
    assert finding.alternatives == ()


@pytest.mark.parametrize("evidence", ["mesh and masks", "points and masks"])
@pytest.mark.parametrize("factor", [0.25, 2.0])
def test_intrinsics_for_another_size_are_named_with_the_factor(whole, evidence, factor):
    report = check_capture(with_intrinsics(EVIDENCE[evidence](whole), factor))
    assert [finding.name for finding in report.findings] == ["intrinsics_of_another_size"]
    assert f"by about {1 / factor:g}" in report.findings[0].remedy


@pytest.mark.parametrize("name", ["", "world_from_cam", "opengl_axes"])
def test_photographs_alone_tell_by_their_features_whatever_the_light(detailed, name):
    capture = with_pose(detailed, name) if name else detailed
    report = check_capture(capture)
    assert report.tested == ("features",)
    assert [finding.name for finding in report.findings] == ([name] if name else [])


def test_rows_and_columns_of_k_exchanged_are_named(whole):
    K = whole.cameras.intrinsics[:, [1, 0, 2]][:, :, [1, 0, 2]]
    capture = whole.replace(cameras=whole.cameras.replace(intrinsics=K))
    assert names(capture) == ["rows_and_columns_swapped"]


def test_cameras_of_another_set_are_no_known_mistake(whole):
    elsewhere = whole.cameras.cam_from_world.clone()
    elsewhere[:, 0, 3] += 40.0
    capture = whole.replace(cameras=whole.cameras.replace(cam_from_world=elsewhere))
    assert "cameras_unexplained" in names(blind(capture, mesh=whole.truth.mesh))


@pytest.mark.parametrize("signs", [(-1, 1, 1), (1, -1, 1), (1, 1, -1)])
def test_an_axis_that_runs_the_other_way_is_named(whole, signs):
    pose = flipped(*signs) @ whole.cameras.cam_from_world
    capture = whole.replace(cameras=whole.cameras.replace(cam_from_world=pose))
    assert names(blind(capture, mesh=whole.truth.mesh)) == ["mirrored"]


def test_a_scaled_rotation_is_named(whole):
    scaled = whole.cameras.cam_from_world.clone()
    scaled[:, :3] *= 2.0
    capture = whole.replace(cameras=whole.cameras.replace(cam_from_world=scaled))
    assert "not_rigid" in names(blind(capture, mesh=whole.truth.mesh))


def test_a_mesh_that_looks_inward_is_named(whole):
    mesh = whole.truth.mesh
    assert names(blind(whole, mesh=mesh.replace(normals_world=-mesh.normals_world))) == [
        "mesh_normals_inward"
    ]
    assert names(blind(whole, mesh=mesh.replace(faces=mesh.faces.flip(1)))) == ["mesh_inside_out"]


def test_a_single_viewpoint_without_cameras_has_nothing_to_test(whole):
    assert str(check_capture(whole.replace(cameras=None))).endswith("nothing: no data.")


def test_a_mistake_is_named_with_its_evidence_and_remedy(whole):
    assert str(check_capture(whole)) == "no mistake found; tested: points."
    told = str(check_capture(with_pose(whole, "world_from_cam")))
    assert re.search(r"world_from_cam: .*points, as given 0.*To do: invert them", told)
