"""A custom module can be inserted between any two stages of a chain."""

import functools

import pytest
import torch
from probes import small_scene
from torch import nn
from torch.nn.functional import normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import OrientedPoints
from pimper_torch.stages.stage import Given

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")

SETTINGS = {"default": {"scales": [0.5, 1.0]}, "paper": {}}
GAPS = {
    "default": (
        *("reconstruct", "silhouettes", "contours", "coarse_surface", "decompose", "warp", "light"),
        *("depth_from_light", "factorize", "sweep", "photometry", "gauge", "fuse", "repair"),
        *("explain", "remesh", "extract"),
    ),
    "paper": (
        *("reconstruct", "silhouettes", "triangulate", "decompose", "warp", "light", "factorize"),
        *("gauge", "integrate", "align", "refine", "extract"),
    ),
}
FINISHING = ("simplify", "relight", "texture", "judge_textures", "judge")


class Mine(nn.Module):
    """Returns a copy of its input, and records it."""

    def __init__(self) -> None:
        super().__init__()
        self.handed = []

    def forward(self, record):
        self.handed.append(record)
        return record.replace()


def chain_on_a_sphere(preset, **stages):
    scene, coarse = (
        each.to(torch.float32) for each in small_scene(num_views=4, width=32, num_points=17)
    )
    given = {
        "reconstruct": Given(scene),
        "silhouettes": Given(pt.Silhouettes.everything(scene.views)),
        "triangulate" if preset == "paper" else "coarse_surface": Given(coarse),
    }
    return pt.load_chain(preset, SETTINGS[preset], **given | stages), scene.views


@functools.cache
def without(preset):
    chain, views = chain_on_a_sphere(preset)
    return chain(views).mesh


@pytest.mark.parametrize(
    ("preset", "behind"),
    # All gaps together, and one by one those of stages that process a few patches per call.
    [*GAPS.items(), *(("default", (stage,)) for stage in ("warp", "factorize", "sweep"))],
)
def test_a_module_after_a_stage_receives_its_record_and_changes_no_bit(preset, behind):
    plain, views = chain_on_a_sphere(preset)
    mine = {stage: Mine() for stage in behind}
    stages = {stage: pt.Then(getattr(plain, stage), own) for stage, own in mine.items()}
    chain, _ = chain_on_a_sphere(preset, **stages)
    mesh, other = chain(views).mesh, without(preset)
    for name in ("vertices_world", "faces", "normals_world", "albedo", "confidence"):
        assert torch.equal(getattr(mesh, name), getattr(other, name))
    assert all(own.handed for own in mine.values())


def test_points_from_light_trigger_a_second_coarse_surface():
    plain, views = chain_on_a_sphere("default")
    corners = plain.coarse_surface.record.mesh.vertices_world
    points = OrientedPoints(
        points_world=corners, normals_world=corners, noise=torch.ones_like(corners[:, 0])
    )

    class Recorded(nn.Module):
        handed = ()

        def forward(self, *arguments):
            self.handed += (arguments,)
            return plain.coarse_surface(*arguments)

    surface = Recorded()
    chain, _ = chain_on_a_sphere("default", depth_from_light=Given(points), coarse_surface=surface)
    mesh = chain(views).mesh
    first, second = surface.handed
    assert len(first) == 3
    assert second[3] is points
    assert torch.equal(mesh.vertices_world, without("default").vertices_world)


@pytest.mark.parametrize("preset", SETTINGS)
def test_gaps_cover_every_stage(preset):
    chain, _ = chain_on_a_sphere(preset)
    spare = {*FINISHING, "depth_points"}  # the last is used only with cameras without points
    spare |= {"coarse_surface"} if preset == "paper" else set()  # used only with a given mesh
    assert {name for name, _ in chain.named_children()} - spare == {*GAPS[preset]}


def test_a_module_after_a_finishing_stage_receives_its_record():
    plain, views = chain_on_a_sphere("default")
    mine = {stage: Mine() for stage in FINISHING}
    stages = {stage: pt.Then(getattr(plain, stage), own) for stage, own in mine.items()}
    chain, _ = chain_on_a_sphere("default", **stages)
    result = chain.finish(chain(views))
    assert all(own.handed for own in mine.values())
    assert torch.equal(result.asset.normal, plain.finish(plain(views)).asset.normal)
    assert [report.name for report in result.report][-6:] == [
        *FINISHING,
        "between stages",
    ]


def test_written_normals_are_vertex_normals_of_the_fused_surface():
    plain, views = chain_on_a_sphere("default")
    fused = Mine()
    chain, _ = chain_on_a_sphere("default", fuse=pt.Then(plain.fuse, fused))
    written, surface = chain(views).mesh, fused.handed[-1]
    own = normalize(vertex_normals(surface.vertices_world, surface.faces), dim=1)
    assert_close(surface.normals_world, own, rtol=0, atol=1e-6)
    # `repair` and `extract` keep these vertices here, in a different order.
    nearest = torch.cdist(written.vertices_world, surface.vertices_world).argmin(dim=1)
    assert_close(written.normals_world, own[nearest], rtol=0, atol=1e-6)
