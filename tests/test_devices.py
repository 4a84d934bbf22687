"""A stage computes on the device of its records, and returns its record on it."""

import functools

import pytest
import torch
from elsewhere import ELSEWHERE, Elsewhere, Far, sent
from probes import small_scene
from torch import Tensor
from torch.utils import _pytree as pytree

import pimper_torch as pt
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch import stages
from pimper_torch.paper.align import Align
from pimper_torch.paper.integrate import Integrate
from pimper_torch.paper.refine import Refine
from tests.coarse import ball
from tests.sfm.ball import cameras_on_an_arc, photographs

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
SLOW = pytest.mark.slow


@functools.cache
def given():
    """Photographs of one side of a ball, and the records of each stage of both chains."""
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=4, width=32))
    contours = stages.TraceContours()(pt.Silhouettes.everything(scene.views), scene.cameras)
    patches = stages.Decompose()(coarse, scene.cameras)
    seen = stages.Warp()(scene.views, scene.cameras, patches)
    light = stages.FitLight()(seen)
    factorized = stages.Factorize()(seen, light)
    solved = stages.FixGauge()(factorized)
    swept = stages.Sweep()(scene.views, scene.cameras, seen, solved)
    surface = stages.Fuse()(swept, contours)
    integrated = Integrate()(solved)
    aligned = Align()(integrated)
    few = stages.Warp()(scene.views, scene.cameras, patches.replace(buckets=patches.buckets[:2]))
    return locals()


@functools.cache
def all_round():
    """Photographs of a ball with its masks, and a mesh."""
    ring = ball.photographed(ball.all_round())
    ring = ring.replace(views=ring.views.replace(masks=ball.silhouettes_of(ring.cameras).masks))
    vertices, faces = icosphere(1)
    outlines = stages.FindSilhouettes()(ring)
    rays = stages.TraceContours()(outlines, ring.cameras)
    mesh = pt.Mesh(vertices_world=vertices.to(ring.views.images), faces=faces)
    return given() | locals()


@functools.cache
def without_cameras():
    cameras = cameras_on_an_arc()
    views = photographs(cameras, lit=False)
    return {"photographs": views.replace(images=views.images.float()), "arc": cameras}


STAGES = [
    pytest.param(stages.Reconstruct, without_cameras, "photographs", marks=SLOW),
    (stages.FindSilhouettes, all_round, "ring"),
    (stages.FindSilhouettes, given, "scene"),
    (stages.TraceContours, all_round, "outlines ring.cameras"),
    (stages.CoarseSurface, all_round, "ring rays mesh"),
    (pt.Triangulate, given, "scene"),
    (stages.Decompose, given, "coarse scene.cameras"),
    (stages.Warp, given, "scene.views scene.cameras patches"),
    (stages.FitLight, given, "few"),
    (stages.Factorize, given, "few light"),
    (stages.FixGauge, given, "factorized"),
    (stages.Sweep, given, "scene.views scene.cameras seen solved"),
    (stages.Fuse, given, "swept contours"),
    (stages.Repair, given, "surface"),
    (stages.Remesh, given, "swept surface contours"),
    (stages.Extract, given, "surface"),
    (Integrate, given, "solved"),
    (Align, given, "integrated"),
    (Refine, given, "aligned"),
]


def leaves(record):
    return [leaf for leaf in pytree.tree_leaves(record) if isinstance(leaf, Tensor)]


def elsewhere(call, *inputs):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # other threads do not have the device
    try:
        with torch.no_grad(), Elsewhere():
            return call(*sent(inputs))
    finally:
        torch.set_num_threads(threads)


def test_the_fake_device_refuses_mixed_devices_like_a_gpu():
    far = Far(torch.arange(6.0).reshape(2, 3))
    with Elsewhere():
        assert torch.equal((2 * far + torch.tensor(1.0)).cpu(), 2 * far.near + 1)
        assert torch.zeros(3, device=far.device).device == ELSEWHERE
        assert far[torch.tensor([1])].sum().item() == 12
        with pytest.raises(RuntimeError, match="two devices"):
            far + torch.zeros(3)
        with pytest.raises(RuntimeError, match="two devices"):
            torch.zeros(3)[Far(torch.zeros(3)) > 0]
        with pytest.raises(TypeError, match="numpy"):
            far.numpy()


@pytest.mark.parametrize(("stage", "make", "names"), STAGES)
def test_a_stage_runs_where_its_records_are(stage, make, names):
    inputs = []
    for name in names.split():
        first, *rest = name.split(".")
        inputs.append(functools.reduce(getattr, rest, make()[first]))
    found = elsewhere(stage(), *inputs)
    assert leaves(found)
    assert all(isinstance(leaf, Far) for leaf in leaves(found))


@pytest.mark.parametrize("preset", [pytest.param("default", marks=SLOW), "paper"])
def test_a_chain_gives_the_same_result_on_either_device(preset):
    scene, coarse = given()["scene"], given()["coarse"]
    settings = {"silhouettes": {"object": "everything"}}
    if preset == "default":
        settings["scales"] = [0.5, 1.0]
    chain = pt.load_chain(preset, settings)
    here = chain(scene, None, coarse.mesh)
    found = elsewhere(chain, scene, None, coarse.mesh)
    assert all(isinstance(leaf, Far) for leaf in leaves(found))
    off = found.mesh.vertices_world.near - here.mesh.vertices_world
    size = here.mesh.vertices_world.std()
    assert off.abs().max() < 1e-3 * size  # torch and compiled kernels round differently
