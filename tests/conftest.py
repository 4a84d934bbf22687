import io
import math
import os
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path

import pytest

# Tests run one per core, and their scenes are tiny: threads would wait longer than they compute.
# Read when torch and numpy are loaded, here and in programs started by tests.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch  # noqa: E402


def pytest_configure(config: pytest.Config) -> None:
    # Not in pyproject.toml: pytest would import the package to resolve the category before
    # jaxtyping's hook is in place.
    config.addinivalue_line("filterwarnings", "error::pimper_torch.runtime.errors.PimperWarning")
    torch.set_num_threads(1)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Run single files in this process: workers take longer to start than most files."""
    files = all(Path(argument.split("::")[0]).is_file() for argument in config.args)
    return 0 if files else None


@pytest.fixture
def generator() -> torch.Generator:
    """Random numbers, the same in every test."""
    return torch.Generator().manual_seed(59)


@pytest.fixture
def shapes_checked(pytestconfig: pytest.Config) -> None:
    """Skip if annotations are not checked at calls."""
    if not pytestconfig.getoption("jaxtyping_packages"):
        pytest.skip("needs --jaxtyping-packages=pimper_torch,pimper_bench,beartype.beartype")


@pytest.fixture
def shapes_unchecked(pytestconfig: pytest.Config) -> None:
    """Skip if annotations are checked before a function can refuse its arguments."""
    if pytestconfig.getoption("jaxtyping_packages"):
        pytest.skip("annotations refuse this first")


_ANSWERED: dict[bytes, object] = {}


def _answered_once(function: Callable[..., object]) -> Callable[..., object]:
    @wraps(function)
    def answer(*given: object) -> object:
        asked = io.BytesIO()
        torch.save((function.__qualname__, given), asked)
        if asked.getvalue() not in _ANSWERED:
            _ANSWERED[asked.getvalue()] = function(*given)
        return _ANSWERED[asked.getvalue()]

    return answer


@pytest.fixture
def lit_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit lights and bake textures once per result: many tests write the same result."""
    from pimper_torch.stages import Relight, Texture

    for stage in (Relight, Texture):
        answer = _answered_once(stage().forward)
        monkeypatch.setattr(stage, "forward", lambda _, *given, answer=answer: answer(*given))


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch, lit_before: None) -> None:
    """Write results with small images: large ones take most of the time."""
    from pimper_torch.export import pictures

    draw, turn = pictures.draw_overview, pictures.draw_turn
    monkeypatch.setattr(pictures, "draw_overview", lambda result, path: draw(result, path, 40))
    monkeypatch.setattr(pictures, "draw_turn", lambda *arguments: turn(*arguments, side_px=8))


@pytest.fixture
def reconstruction():
    """A small, complete result: a bump on a square, with three cameras."""
    from torch.nn.functional import normalize

    from pimper_bench.scenes.procedural_meshes import table
    from pimper_bench.scenes.scene_cameras import arc_cameras
    from pimper_torch.geometry.projection import project
    from pimper_torch.geometry.rigid import rigid
    from pimper_torch.geometry.surfaces import vertex_normals
    from pimper_torch.records import (
        CameraModel,
        CoarseMesh,
        Convergence,
        DepthPatches,
        Depths,
        Mesh,
        PatchSet,
        PhotometricPatches,
        Photometry,
        Reconstruction,
        Silhouettes,
        SparseScene,
        StageReport,
        Templates,
        Views,
    )

    generator = torch.Generator().manual_seed(75)
    cameras = arc_cameras(3, width=60, height=40, focal_px=90.0, distance=6.0, span_deg=30.0)
    cameras = cameras.replace(
        intrinsics=cameras.intrinsics.float(), cam_from_world=cameras.cam_from_world.float()
    )
    flat = table(1.0, cells=14).to(torch.float32)
    faces, xy = flat.faces, flat.vertices_world[:, :2]
    height = 0.5 * torch.exp(-3 * xy.square().sum(dim=1, keepdim=True))
    vertices = torch.cat([xy, height], dim=1)
    mesh = Mesh(
        vertices_world=vertices,
        faces=faces,
        normals_world=vertex_normals(vertices, faces),
        albedo=3 * torch.rand(len(vertices), 3, generator=generator),
        confidence=torch.rand(len(vertices), generator=generator),
    )
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    coarse = CoarseMesh(
        mesh=Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2], [0, 2, 3]])),
        reference=1,
        is_point=torch.tensor([True, True, True, False]),
    )
    images = torch.rand(3, 3, 40, 60, generator=generator)
    views = Views(
        images=images,
        sizes_px=cameras.sizes_px,
        names=("a.png", "b.png", "c.png"),
        focals_px=torch.full((3,), torch.nan),
    )
    points = vertices[::8]
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    count = len(points)
    lens = CameraModel(
        camera=1, model="PINHOLE", params=(90.0, 90.0, 30.0, 20.0), width=60, height=40
    )
    scene = SparseScene(
        views=views,
        cameras=cameras,
        points_world=points,
        reprojection_errors_px=torch.zeros(count),
        observation_point=torch.arange(count).repeat(3),
        observation_view=torch.arange(3).repeat_interleave(count),
        observation_pixels=pixels.reshape(-1, 2),
        lenses=(lens,) * 3,
        unregistered=("d.png",),
    )
    rotation = torch.linalg.qr(torch.randn(2, 3, 3, generator=generator)).Q
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    ones = torch.ones(2, 4, 4)
    templates = Templates(
        facet=torch.tensor([1, 0]),
        patch_from_world=rigid(rotation, torch.zeros(2, 3)),
        origin=torch.zeros(2, 2),
        spacing=torch.ones(2),
        depth=torch.zeros(2, 4, 4),
        barycentric=torch.full((2, 4, 4, 3), 1 / 3),
        inside=ones > 0,
    )
    lights_patch = torch.randn(2, 3, 4, generator=generator)
    lights_patch[0, 2] = 0  # a view without the patch
    photometry = Photometry(
        normals_patch=normalize(torch.tensor([0.1, 0.2, -1.0]), dim=0).expand(2, 4, 4, 3),
        albedo=ones[..., None].expand(2, 4, 4, 3),
        lights_patch=lights_patch,
        valid=ones > 0,
        information=1e3 * ones,
        status=torch.tensor([0, 4]),
        convergence=Convergence(
            iterations=torch.tensor([12, 40]),
            residual=torch.tensor([0.1, 0.3]),
            cause=torch.tensor([0, 2]),
        ),
    )
    patches = PatchSet(coarse=coarse, buckets=(templates,))
    photometric = PhotometricPatches(patches=patches, buckets=(photometry,))
    depths = Depths(
        depth=0 * ones, valid=ones > 0, transform=torch.tensor([[0.0, 0, 1, 0]]).repeat(2, 1)
    )
    return Reconstruction(
        mesh=mesh,
        scene=scene,
        silhouettes=Silhouettes.everything(scene.views),
        coarse=coarse,
        patches=DepthPatches(photometric=photometric, buckets=(depths,)),
        report=(
            StageReport(
                name="warp",
                seconds=1.5,
                peak_memory_mb=300.0,
                figures={"samples": 96, "missing_samples": 24},
            ),
            StageReport(name="extract", seconds=0.5, peak_memory_mb=310.0, figures={}),
        ),
    )


@pytest.fixture(scope="session")
def lift():
    """Facets ``height`` samples above a photographed plane with known light.

    The plane is textured or has uniform albedo; ``normal`` is its normal.
    """
    from types import SimpleNamespace

    from pimper_bench.scenes import render_shape
    from pimper_bench.scenes.render_in_memory import EndlessPlane
    from pimper_bench.scenes.scene_cameras import arc_cameras
    from pimper_bench.scenes.scene_lights import wandering_lights
    from pimper_bench.scenes.textures import random_speckle
    from pimper_torch.geometry.rigid import rotate
    from pimper_torch.records import CoarseMesh, Mesh, PhotometricPatches
    from pimper_torch.stages.patches.decompose import Decompose
    from pimper_torch.stages.patches.patches_config import DecomposeConfig
    from pimper_torch.stages.patches.warp import Warp

    slant = (0.15, -0.1, 1.0)

    @cache
    def make(height: float, textured: bool = True) -> SimpleNamespace:
        generator = torch.Generator().manual_seed(64)
        cameras = arc_cameras(9, width=120, height=90, focal_px=330.0, distance=3.0, span_deg=50.0)
        point_lights = wandering_lights(
            9, generator, distance=5.0, spread_deg=35.0, min_tilt_deg=5.0, irradiance=0.6
        )
        speckle = random_speckle(generator, cells=(0.12, 0.05), contrast=1.0)

        def bare(points: torch.Tensor) -> torch.Tensor:
            return torch.full_like(points, 0.5)

        texture = speckle if textured else bare
        scene = render_shape(
            EndlessPlane(normal=slant), cameras, point_lights.harmonics_world(), texture
        )
        normal = torch.tensor(slant, dtype=torch.float64)
        normal = normal / normal.norm()
        xy = torch.tensor([[-0.3, -0.25], [0.3, -0.25], [0.3, 0.25], [-0.3, 0.25]]).double()
        flat = torch.cat([xy, -(xy @ normal[:2, None]) / normal[2]], dim=1)
        spacing = 3.0 / 330.0
        mesh = Mesh(
            vertices_world=flat + height * spacing * normal,
            faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
        )
        coarse = CoarseMesh(mesh=mesh, reference=4, is_point=torch.ones(4, dtype=torch.bool))
        # The arc looks from +z, so the facets must be wound to face it.
        patches = Decompose(DecomposeConfig(overlap_samples=2.0))(coarse, cameras)
        seen = Warp()(scene.views, cameras, patches)
        photometric = PhotometricPatches.of(
            patches,
            normals=[
                rotate(one.patch_from_world, normal.expand(len(one.facet), 1, 3))[
                    :, :, None
                ].expand(*one.depth.shape, 3)
                for one in patches.buckets
            ],
            albedo=[torch.ones(*one.depth.shape, 3) for one in patches.buckets],
            lights=scene.lights_world,
            information=1 / math.radians(8 / 3) ** 2,
        )
        buckets = []
        for bucket in photometric.buckets:
            residual = torch.full_like(bucket.convergence.residual, 0.005)
            rest = bucket.convergence.replace(residual=residual)
            buckets.append(bucket.replace(convergence=rest))
        photometric = photometric.replace(buckets=tuple(buckets))
        return SimpleNamespace(
            normal=normal,
            scene=scene,
            seen=seen,
            photometric=photometric,
            height=height
            * float(patches.buckets[0].spacing[0] / spacing)
            * spacing
            / float(patches.buckets[0].spacing[0]),
        )

    return make


@pytest.fixture(scope="session")
def dtu(tmp_path_factory):
    """Write scan 9 with three positions, lights 0 and 3, and the files of its protocol."""
    import numpy as np
    import scipy.io
    from PIL import Image

    from pimper_bench.scenes.procedural_meshes import icosphere
    from pimper_bench.scenes.scene_cameras import arc_cameras
    from pimper_torch.records import Mesh

    cameras = arc_cameras(3, width=1600, height=1200, focal_px=2000.0, distance=600.0)
    root = tmp_path_factory.mktemp("dtu")
    photographs, calibration = root / "Rectified" / "scan9", root / "Calibration" / "cal18"
    for folder in (photographs, calibration, root / "Points" / "stl", root / "ObsMask"):
        folder.mkdir(parents=True)
    K = cameras.intrinsics.clone()
    K[:, :2, 2] -= 0.5
    picture = Image.fromarray(np.full((1200, 1600, 3), 90, dtype=np.uint8))
    for place in (1, 2, 3):
        for light in (0, 3):
            picture.save(photographs / f"rect_{place:03d}_{light}_r5000.png")
        matrix = K[place - 1] @ cameras.cam_from_world[place - 1, :3]
        np.savetxt(calibration / f"pos_{place:03d}.txt", matrix.numpy())
    vertices, _ = icosphere(4)
    cloud = Mesh(vertices_world=10 * vertices, faces=torch.zeros(0, 3, dtype=torch.long))
    rows = "\n".join(" ".join(f"{x:.6f}" for x in row) for row in cloud.vertices_world.tolist())
    properties = "\n".join(f"property float {axis}" for axis in "xyz")
    (root / "Points" / "stl" / "stl009_total.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(cloud.vertices_world)}\n{properties}\n"
        f"end_header\n{rows}\n"
    )
    corners = np.array([[-12.0] * 3, [12.0] * 3])
    mask = {"ObsMask": np.ones((25, 25, 25)), "BB": corners, "Res": np.array([[1.0]])}
    scipy.io.savemat(root / "ObsMask" / "ObsMask9_10.mat", mask)
    scipy.io.savemat(root / "ObsMask" / "Plane9.mat", {"P": np.array([[0.0], [0], [1], [20]])})
    return root


@pytest.fixture
def problem(generator):
    """Random factors on the cone, their exact product, and a perturbed initial value."""
    from torch.nn.functional import normalize

    from pimper_torch.lighting.light_field import harmonics
    from pimper_torch.stages.photometry.bilinear import Bilinear
    from pimper_torch.stages.photometry.cone import project_to_cone

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def random_lights(views: int) -> torch.Tensor:
        lights = 0.5 * normal(views, 4)
        lights[:, 0] = 1 + lights[:, 0].abs()
        lights[:, 3] = -0.6 - lights[:, 3].abs()  # from the viewer's side
        return lights

    def make(
        patches: int = 2, views: int = 20, samples: int = 150, off: float = 0.05, missing: float = 0
    ) -> tuple[Bilinear, torch.Tensor, torch.Tensor]:
        n = normalize(normal(patches, samples, 3), dim=-1)
        n[..., 2] = -n[..., 2].abs()
        albedo = 0.4 + 0.2 * normal(patches, samples).abs()
        shading = (albedo[..., None] * harmonics(n)).mT
        lights = torch.stack([random_lights(views) for _ in range(patches)])
        draw = torch.rand(patches, views, samples, generator=generator, dtype=torch.float64)
        weight = (draw >= missing).double()
        start = lights + off * normal(*lights.shape)
        from_shading = project_to_cone((shading + off * normal(*shading.shape)).mT).mT
        given = Bilinear(
            radiance=weight * (lights @ shading),
            weight=weight,
            lights=start,
            prior_mean=start,
            shading=from_shading,
            regularization=torch.zeros(patches, views, dtype=torch.float64),
        )
        return given, lights, shading

    return make
