"""What a chain determines before its first pass, and steps that continue from it."""

import pytest
import torch
from probes import small_scene

import pimper_torch as pt
from pimper_torch.stages.stage import Given

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")


@pytest.fixture(scope="module")
def sphere():
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=48))
    return scene, coarse


def chain_of(sphere, preset="default", **stages):
    scene, coarse = sphere
    given = {
        "silhouettes": Given(pt.Silhouettes.everything(scene.views)),
        "triangulate" if preset == "paper" else "coarse_surface": Given(coarse),
    }
    changes = {"scales": [0.5, 1.0]} if preset == "default" else {}
    return pt.load_chain(preset, changes, **given | stages)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_steps_from_what_was_prepared_are_those_from_photographs(sphere, preset):
    chain = chain_of(sphere, preset)
    prepared = chain.prepare(sphere[0])
    for own, plain in zip(chain.steps(prepared), chain.steps(sphere[0]), strict=True):
        assert torch.equal(own.surface.vertices_world, plain.surface.vertices_world)
        assert [each.name for each in own.reports] == [each.name for each in plain.reports]
    assert prepared.decisions["cameras"] == "given"
    assert prepared.coarse is sphere[1]


def test_a_loop_prepares_once_and_steps_from_other_photographs(sphere):
    class Counted(Given):
        count = 0

        def forward(self, *given):
            Counted.count += 1
            return super().forward(*given)

    chain = chain_of(sphere, coarse_surface=Counted(sphere[1]))
    prepared = chain.prepare(sphere[0])
    views = prepared.scene.views
    gain = torch.ones(views.num_views, 1, 1, 1, requires_grad=True)
    for _ in range(2):
        images = views.images * gain
        scene = prepared.scene.replace(views=views.replace(images=images))
        *_, step = chain.steps(prepared.replace(scene=scene))
        sum(bucket.lights_patch.square().sum() for bucket in step.photometric.buckets).backward()
    assert Counted.count == 1
    assert gain.grad is not None
    assert gain.grad.isfinite().all()
    assert (gain.grad != 0).all()


def test_steps_from_a_frozen_step_have_its_templates(sphere):
    chain = chain_of(sphere)
    step = next(chain.steps(sphere[0]))
    frozen = step.frozen()
    assert torch.equal(frozen.coarse.mesh.vertices_world, step.coarse.mesh.vertices_world)
    assert torch.equal(frozen.patches.surface.vertices_world, step.surface.vertices_world)
    cameras = sphere[0].cameras.retract(torch.full((6, 6), 1e-4))
    again = next(chain.steps(frozen.replace(scene=frozen.scene.replace(cameras=cameras))))
    assert torch.equal(again.coarse.mesh.faces, step.coarse.mesh.faces)
    assert "depth_from_light" in {report.name for report in step.reports}
    after = [report.name for report in again.reports][len(frozen.reports) :]
    assert not {"decompose", "depth_from_light", "remesh"} & set(after)
    assert "photometry" in after


def test_cameras_and_meshes_belong_to_the_preparation(sphere):
    chain = chain_of(sphere)
    prepared = chain.prepare(sphere[0])
    with pytest.raises(pt.InputError, match="give them to `prepare`"):
        next(chain.steps(prepared, mesh=sphere[1].mesh))


def test_held_out_photographs_are_a_decision(sphere):
    chain = chain_of(sphere)
    chain.hold_out = 4
    prepared = chain.prepare(sphere[0])
    names = sorted(sphere[0].views.names)
    assert prepared.held_out.views.names == (names[3],)
    assert prepared.decisions["held out"] == names[3]


def test_the_stage_of_samples_normals_and_heights_is_replaced_as_a_whole(sphere):
    plain = chain_of(sphere)

    class Mine(torch.nn.Module):
        handed = ()

        def forward(self, *given):
            Mine.handed += (given[0],)
            return plain.photometry(*given)

    chain = chain_of(sphere, photometry=Mine())
    *_, step = chain.steps(sphere[0])
    assert len(Mine.handed) == 2
    assert Mine.handed[0] == (chain.warp, chain.factorize, chain.sweep)
    assert step.last


def test_kernels_of_gradients_are_compiled_ahead_if_gradients_are_recorded(sphere, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "pimper_torch.chains.chain.compile_ahead", lambda gradients: asked.append(gradients)
    )
    chain = chain_of(sphere)
    chain.prepare(sphere[0])
    with torch.no_grad():
        chain.prepare(sphere[0])
    assert asked == [True, False]
