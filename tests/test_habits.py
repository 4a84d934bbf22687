"""Chains and stages are moved, copied, saved and compiled like other torch modules."""

import copy
import functools
import pickle

import pytest
import torch
from probes import small_scene
from torch import nn

import pimper_torch as pt
from pimper_torch.records import Silhouettes
from pimper_torch.stages.stage import Given

# Few patches have enough lit views.
LIT = pytest.mark.filterwarnings("ignore:Factorization", "ignore:Not usable. light determines")


class Scaled(pt.Stage):
    """A factorization with a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.factorize = pt.Factorize()
        self.gain = nn.Parameter(torch.ones(1))

    def forward(self, seen: pt.PatchViews, light: pt.stages.Illumination) -> pt.PhotometricPatches:
        return self.factorize(seen, light)


@functools.cache
def given():
    return tuple(each.to(torch.float32) for each in small_scene(num_views=4, width=32))


def small_chain(**stages):
    scene, coarse = given()
    outlines = Given(Silhouettes.everything(scene.views))
    stages |= {"silhouettes": outlines, "coarse_surface": Given(coarse)}
    return pt.load_chain("default", {"scales": [1.0]}, **stages)


@functools.cache
def mesh():
    return small_chain()(given()[0]).mesh


@pytest.mark.parametrize(
    "moved",
    [
        lambda module: module.to("meta"),
        lambda module: module.to("cuda"),
        lambda module: module.to(torch.float64),
        lambda module: module.to(torch.zeros(1).double()),
        lambda module: module.cuda(),
        lambda module: module.double(),
        lambda module: module.half(),
    ],
)
@pytest.mark.parametrize("make", [small_chain, pt.Published, pt.Warp])
def test_moving_a_chain_without_parameters_warns_and_changes_nothing(make, moved):
    module = make()
    message = rf"{type(module).__name__} has no parameters.*records.*`views.to\('cuda'\)`"
    with pytest.warns(pt.PimperWarning, match=message) as caught:
        assert moved(module) is module
    assert len(caught) == 1
    assert caught[0].filename == __file__


def test_module_calls_without_effect_are_silent(recwarn):
    chain = small_chain()
    silent = chain.to("cpu").cpu().float().to(torch.float32).eval().train().requires_grad_(False)
    silent.share_memory().to(memory_format=torch.channels_last).zero_grad()
    assert silent is chain
    assert not recwarn.list


def test_parameters_of_a_chain_and_of_its_container_move(recwarn):
    chain = small_chain(factorize=Scaled()).double()
    assert chain.factorize.gain.dtype == torch.float64
    assert chain.to("meta").factorize.gain.device.type == "meta"
    assert not recwarn.list
    with pytest.warns(pt.PimperWarning, match="CoarseToFine has no parameters") as caught:
        model = nn.ModuleDict({"chain": small_chain(), "head": nn.Linear(2, 2)}).to("meta")
    assert len(caught) == 1
    assert model["head"].weight.device.type == "meta"


def test_the_state_dict_of_a_chain_has_the_parameters_of_its_stages():
    assert small_chain().state_dict() == {}
    chain, other = small_chain(factorize=Scaled()), small_chain(factorize=Scaled())
    with torch.no_grad():
        chain.factorize.gain.fill_(2)
    other.load_state_dict(chain.state_dict())
    assert list(chain.state_dict()) == ["factorize.gain"]
    assert other.factorize.gain.item() == 2


@LIT
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda chain: pickle.loads(pickle.dumps(chain))])
def test_a_copy_of_a_chain_gives_the_same_bits(copied):
    chain = small_chain()
    again = copied(chain)
    assert again is not chain
    assert again.config == chain.config
    found = again(given()[0]).mesh
    assert torch.equal(found.vertices_world, mesh().vertices_world)
    assert torch.equal(found.albedo, mesh().albedo)


@pytest.mark.parametrize("wrapped", [torch.compile, nn.DataParallel])
def test_a_compiled_or_replicated_warp_gives_the_same_result(wrapped):
    scene, coarse = given()
    patches = pt.Decompose()(coarse, scene.cameras)
    patches = patches.replace(buckets=patches.buckets[:1])
    expected = pt.Warp()(scene.views, scene.cameras, patches)
    found = wrapped(pt.Warp())(scene.views, scene.cameras, patches)
    for one, other in zip(found.buckets, expected.buckets, strict=True):
        assert torch.equal(one.valid, other.valid)
        torch.testing.assert_close(one.radiance, other.radiance, rtol=0, atol=1e-6)


def test_a_copy_of_a_chain_keeps_a_store(tmp_path):
    chain = pt.load_chain("default", cache=tmp_path / "kept")
    for again in (copy.deepcopy(chain), pickle.loads(pickle.dumps(chain))):
        assert again.store.folder == chain.store.folder
