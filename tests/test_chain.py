"""Complete chains, from photographs to mesh."""

import logging
import warnings

import pytest
import torch
from photographs import save_masks, save_photographs
from probes import small_scene
from torch import nn
from torch.nn.functional import normalize
from view_comparison import compare_in_view

import pimper_torch as pt
from pimper_bench.metrics import pair_views, similarity_between_cameras
from pimper_bench.metrics.in_view import angles_deg
from pimper_bench.scenes import RenderedScene, potato_on_table, render_shape
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.render_in_memory import EndlessPlane, Shape, Sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_bench.scenes.textures import random_speckle
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.chains.prepare import locate, split_held_out
from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.paper.triangulate import Triangulate
from pimper_torch.records import (
    CoarseMesh,
    Mesh,
    Reconstruction,
    SparseScene,
    Surface,
    SweptPatches,
)
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.coarse.surface import CoarseSurface
from pimper_torch.stages.stage import Given
from tests.coarse import ball

log = logging.getLogger(__name__)  # pytest --log-cli-level=INFO shows the figures

PRESETS = ("paper", "default")
REFERENCES = {"fast": "coarse_surface", "paper": "triangulate"}
# Images of 80 x 60 pixels are too small for dense matching: facets span the cloud.
SMALL = {
    "paper": {"triangulate": {"num_points": 20}},
    "default": {
        "scales": [0.5, 1.0],
        "extract": {"max_hole": 0.2},  # facets beyond the cloud's hull are arbitrary
    },
}


class OneSide(pt.Stage):
    """Triangulates the cloud in one view, as coarse surface instead of a closed one."""

    def __init__(self, num_points: int) -> None:
        super().__init__()
        self.triangulate = Triangulate(TriangulateConfig(num_points=num_points))

    def forward(self, scene: SparseScene, *_: object) -> CoarseMesh:
        return self.triangulate(scene)


def photographed(shape: Shape, seed: int, **settings: object) -> RenderedScene:
    generator = torch.Generator().manual_seed(seed)
    options = {"width": 80, "height": 60, "focal_px": 235.0, "distance": 3.0, "span_deg": 40.0}
    cameras = arc_cameras(9, **(options | settings))
    # At most 35 degrees off: visible surface has no shadows, so first order is exact.
    point_lights = wandering_lights(
        9, generator, distance=5.0, spread_deg=35.0, min_tilt_deg=5.0, irradiance=0.6
    )
    texture = random_speckle(generator, cells=(0.3, 0.1), contrast=1.0)
    return render_shape(shape, cameras, point_lights.harmonics_world(), texture)


def small_chain(preset: str, scene: SparseScene) -> pt.Chain:
    chain = pt.load_chain(preset, SMALL[preset], reconstruct=Given(scene))
    if preset == "default":
        chain.coarse_surface = OneSide(num_points=20)
    return chain


def surface_of(scene: RenderedScene, preset: str, num_points: int = 150) -> Reconstruction:
    generator = torch.Generator().manual_seed(17)
    return small_chain(preset, sparse_scene(scene, num_points, generator))(scene.views)


def sample_spacing(result: Reconstruction) -> float:
    return float(result.patches.patches.buckets[0].spacing.mean())


@pytest.mark.parametrize("preset", PRESETS)
def test_a_tilted_plane_is_reconstructed_as_a_plane(preset):
    plane = EndlessPlane(normal=(0.3, -0.2, 1.0))
    with warnings.catch_warnings():
        # A single normal does not determine the light, so a warning is legitimate.
        warnings.simplefilter("ignore", PimperWarning)
        result = surface_of(photographed(plane, 161), preset)
    vertices = result.mesh.vertices_world.double()
    normal = torch.tensor(plane.normal, dtype=torch.float64)
    normal = normal / normal.norm()
    off = (vertices @ normal).abs()
    spacing = sample_spacing(result)
    assert off.square().mean().sqrt() < 0.05 * spacing
    assert off.max() < 0.5 * spacing
    normals = vertex_normals(vertices, result.mesh.faces)
    assert angles_deg(normals, normal.expand_as(normals)).mean() < 1


def height_over_sphere(mesh: Mesh) -> torch.Tensor:
    """Signed distances to the unit sphere of points inside each face, not only at its corners."""
    corners = mesh.vertices_world.double()[mesh.faces]
    weights = torch.tensor([[2, 1, 1], [1, 2, 1], [1, 1, 2], [4 / 3, 4 / 3, 4 / 3]]).double() / 4
    inner = torch.einsum("pk,fkc->fpc", weights, corners).reshape(-1, 3)
    return inner.norm(dim=1) - 1


# The facets cover only a cap, with flat sides, and silhouettes show the complete sphere.
PART_OF_SPHERE = pytest.mark.filterwarnings("ignore:.*the surface (lacks|sticks)")


@PART_OF_SPHERE
@pytest.mark.parametrize("preset", PRESETS)
def test_a_spherical_cap_is_reconstructed_better_than_its_facets(preset):
    scene = photographed(Sphere(), 162, target=(0.0, 0.0, 1.0))
    result = surface_of(scene, preset)
    facets = OneSide(num_points=20)(result.scene)
    coarse = height_over_sphere(facets.mesh).square().mean().sqrt()
    fine = height_over_sphere(result.mesh).square().mean().sqrt()
    log.info("%s: sphere, facets off by %.5f, surface by %.5f", preset, coarse, fine)
    assert fine < 0.3 * coarse  # measured 0.15 with paper, 0.24 with default


@PART_OF_SPHERE
@pytest.mark.parametrize("preset", PRESETS)
def test_identical_lights_give_a_warning_and_a_surface(preset):
    scene = photographed(Sphere(), 163, target=(0.0, 0.0, 1.0))
    same = scene.lights_world[:1].expand(9, 4).contiguous()
    generator = torch.Generator().manual_seed(164)
    texture = random_speckle(generator, cells=(0.3, 0.1), contrast=1.0)
    scene = render_shape(Sphere(), scene.cameras, same, texture)
    with pytest.warns(PimperWarning, match="light"):
        result = surface_of(scene, preset)
    coarse = height_over_sphere(result.coarse.mesh).square().mean().sqrt()
    fine = height_over_sphere(result.mesh).square().mean().sqrt()
    assert result.mesh.vertices_world.isfinite().all()
    assert fine < 1.5 * coarse


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
def test_held_out_photographs_do_not_affect_the_surface():
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=48))
    used, held = split_held_out(scene, 3)

    def of(some, hold_out):
        stages = {"silhouettes": Given(pt.Silhouettes.everything(used.views))}
        stages |= {"reconstruct": Given(some), "coarse_surface": Given(coarse)}
        settings = {"scales": [1.0], "hold_out": hold_out}
        return pt.load_chain("default", settings, **stages)(some.views)

    result, alone = of(scene, 3), of(used, 0)
    assert result.held_out.views.names == held.views.names
    assert result.scene.views.names == used.views.names
    assert torch.equal(result.mesh.vertices_world, alone.mesh.vertices_world)
    assert alone.held_out is None


class Dragging(nn.Module):
    """A fusion that folds the surface: it moves the vertex nearest to the view's axis."""

    def __init__(self, fuse: nn.Module) -> None:
        super().__init__()
        self.fuse = fuse
        self.sound: list[Surface] = []

    def forward(self, swept: SweptPatches, contours: Contours, expected: bool = True) -> Surface:
        surface: Surface = self.fuse(swept, contours, expected)
        self.sound.append(surface)
        vertices = surface.vertices_world.clone()
        vertices[self.dragged(surface), 0] += 0.3
        return surface.replace(vertices_world=vertices)

    @staticmethod
    def dragged(surface: Surface) -> int:
        return int(surface.vertices_world[:, :2].norm(dim=1).argmin())


class Spy(nn.Module):
    """Records the surface that a stage receives."""

    def __init__(self, stage: nn.Module) -> None:
        super().__init__()
        self.stage = stage
        self.surface: Surface | None = None

    def forward(self, swept: SweptPatches, surface: Surface, contours: Contours) -> CoarseMesh:
        self.surface = surface
        found: CoarseMesh = self.stage(swept, surface, contours)
        return found


@PART_OF_SPHERE
def test_folds_are_repaired_before_remeshing_and_extraction():
    scene = photographed(Sphere(), 165, target=(0.0, 0.0, 1.0))
    pimper = small_chain("default", sparse_scene(scene, 150, torch.Generator().manual_seed(17)))
    pimper.fuse, pimper.remesh = Dragging(pimper.fuse), Spy(pimper.remesh)
    result = pimper(scene.views)
    last = pimper.fuse.sound[-1]
    for sound, found in ((pimper.fuse.sound[0], pimper.remesh.surface), (last, result.mesh)):
        place = sound.vertices_world[Dragging.dragged(sound)]
        away = (found.vertices_world - place).norm(dim=1)
        assert away.min() < 0.01
        assert found.confidence[away.argmin()] == 0


def compared(mesh: Mesh, result: Reconstruction, truth: RenderedScene):
    """Compare depths in the reference view, on the object without its table."""
    ours, theirs = pair_views(result.scene.views.names, truth.views.names)
    truth_from_world = similarity_between_cameras(
        result.cameras.take(ours.tolist()), truth.cameras.take(theirs.tolist())
    )
    name = result.scene.views.names[result.coarse.reference]
    view = truth.views.names.index(name)
    return compare_in_view(
        mesh,
        truth_from_world,
        truth.cameras,
        view,
        truth.depth[view],
        normals_true=truth.normals_world[view],
        where=truth.foreground[view],
    )


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")  # few views
@pytest.mark.parametrize("masked", [pytest.param(False, marks=pytest.mark.slow), True])
def test_default_improves_on_a_closed_coarse_surface(masked):
    """With a coarse surface configured for small photographs."""
    scene = ball.photographed(ball.all_round())
    if masked:
        masks = ball.silhouettes_of(scene.cameras).masks
        scene = scene.replace(views=scene.views.replace(masks=masks))
    settings = {"scales": [0.5, 1.0]} | (
        {} if masked else {"silhouettes": {"object": "everything"}}
    )
    result = pt.load_chain("default", settings, coarse_surface=CoarseSurface(ball.SETTINGS))(scene)
    mesh, coarse = result.mesh, result.coarse.mesh
    off = mesh.vertices_world.norm(dim=1) - 1
    chords = coarse.vertices_world[coarse.faces].mean(dim=1).norm(dim=1) - 1
    # Measured: 0.0012 and 0.0016, the facets of the last pass 0.009; median angle 0.93 degrees.
    assert off.abs().mean() < 0.0025
    assert off.abs().max() < 0.02
    assert off.abs().mean() < 0.25 * chords.abs().mean()
    assert angles_deg(mesh.normals_world, normalize(mesh.vertices_world, dim=1)).median() < 1.3
    (extracted,) = [one for one in result.report if one.name == "extract"]
    assert extracted.figures["openings"] == 0


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")  # few views
def test_fast_gives_a_closed_surface_in_one_pass():
    scene = ball.photographed(ball.all_round())
    views = scene.views.replace(masks=ball.silhouettes_of(scene.cameras).masks)
    result = pt.load_chain("fast", coarse_surface=CoarseSurface(ball.SETTINGS))(
        scene.replace(views=views)
    )
    off = result.mesh.vertices_world.norm(dim=1) - 1
    assert off.abs().mean() < 0.004  # measured: 0.0019
    (extracted,) = [one for one in result.report if one.name == "extract"]
    assert extracted.figures["openings"] == 0
    assert [one.name for one in result.report].count("fuse") == 1


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "default::pimper_torch.runtime.errors.PimperWarning"
)  # facets at the contour
def test_default_reaches_the_stated_accuracy_on_small_photographs(tmp_path):
    truth = potato_on_table(num_views=9, width=160, height=120)
    save_photographs(truth.views, tmp_path / "photos")
    save_masks(truth.foreground, truth.views.names, tmp_path / "masks")
    views = pt.load_views(tmp_path / "photos", masks=tmp_path / "masks")
    placed = sparse_scene(truth, 600, torch.Generator().manual_seed(17))
    pimper = pt.load_chain("default", {"coarse_surface": {"num_facets": 400}})
    pimper.reconstruct = Given(placed.replace(views=views))
    result = pimper(views)
    facets = compared(result.coarse.mesh, result, truth)
    surface = compared(result.mesh.replace(normals_world=None), result, truth)
    for name, figures in (("facets", facets), ("surface", surface)):
        log.info("small photographs: %s %s", name, figures)
    # Measured: 99.7 % covered, depth error 1.60 % (facets 2.27), mean angle 3.5 degrees (7.5),
    # median 2.9. An earlier version had 1.65 % (facets 2.36).
    assert surface.coverage > 0.98
    assert surface.relative_error < 1.64
    assert surface.mean_angle_deg < 4.1
    assert surface.median_angle_deg < 3.5
    assert surface.relative_error < 0.72 * facets.relative_error
    assert surface.mean_angle_deg < 0.5 * facets.mean_angle_deg


@pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_views_of_one_pose_share_a_silhouette_and_have_own_lights(preset):
    cameras = ball.all_round().take(torch.arange(24) // 2)
    scene = ball.photographed(cameras)
    vertices, faces = icosphere(2)
    some = Mesh(vertices_world=vertices, faces=faces[:80])
    step = next(pt.load_chain(preset).steps(scene, mesh=some))
    assert step.scene.views.poses.tolist() == [view - view % 2 for view in range(24)]
    assert torch.equal(step.silhouettes.inside[::2], step.silhouettes.inside[1::2])
    lights = torch.cat([bucket.lights_patch for bucket in step.photometric.buckets])
    both = (lights[:, ::2] != 0).any(dim=2) & (lights[:, 1::2] != 0).any(dim=2)
    assert int(both.sum()) > 200
    assert bool((lights[:, ::2] != lights[:, 1::2]).any(dim=2)[both].all())
    names = scene.views.names
    again = pt.load_chain(preset, {REFERENCES[preset]: {"reference": names[7]}})
    named = next(again.steps(scene, mesh=some.replace(faces=faces[:8])))
    assert named.coarse.reference == 7


class Mine(nn.Module):
    """A custom structure from motion: returns known cameras, and records its arguments."""

    def __init__(self, scene: SparseScene) -> None:
        super().__init__()
        self.scene, self.asked = scene, []

    def forward(self, views: pt.Views, sparse_model: object = None) -> SparseScene:
        self.asked.append((views.names, sparse_model))
        return self.scene.replace(views=views)


class MineWithPoints(Mine):
    def with_points(self, scene: SparseScene) -> SparseScene:
        return scene.replace(points_world=scene.points_world + 1)


# Very few points, and depth maps that agree by chance.
@pytest.mark.filterwarnings("ignore:No points:pimper_torch.runtime.errors.PimperWarning")
@pytest.mark.parametrize("preset", PRESETS)
def test_a_custom_structure_from_motion_gives_poses_and_optionally_points(reconstruction, preset):
    scene, points = reconstruction.scene, reconstruction.scene.points_world
    for mine, added in ((Mine(scene), 0), (MineWithPoints(scene), 1)):
        chain = pt.load_chain(preset, reconstruct=mine)
        placed = locate(chain, chain.running(), scene.views, "model")[0]
        assert mine.asked == [(scene.views.names, "model")]
        assert torch.equal(placed.points_world, points)
        # A scene has cameras: only points may be requested.
        given = locate(chain, chain.running(), scene)[0]
        assert torch.equal(given.points_world, points + added)
        assert len(mine.asked) == 1
