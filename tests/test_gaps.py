"""A module of one's own stands in the gap between any two stages of a chain."""

import functools

import pytest
import torch
from probes import small_scene
from torch import nn

import pimper_torch as pt
from pimper_torch.chains.running import Running
from pimper_torch.stage import Given

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.errors.PimperWarning")

SETTINGS = {"default": {"scales": [0.5, 1.0]}, "paper": {}}
WAITING = pytest.mark.xfail(
    strict=True, raises=ValueError, reason="stages behind the warp unpack what is put off"
)
GAPS = [
    *(("default", name) for name in ("reconstruct", "silhouettes", "contours", "coarse_surface")),
    ("default", "decompose"),
    pytest.param("default", "warp", marks=WAITING),
    pytest.param("default", "factorize", marks=WAITING),
    *(("default", name) for name in ("sweep", "fuse", "repair", "remesh", "extract")),
    *(("paper", name) for name in ("reconstruct", "silhouettes", "triangulate", "decompose")),
    *(("paper", name) for name in ("warp", "factorize", "integrate", "align", "refine", "extract")),
]


class Mine(nn.Module):
    """A module that gives what it is handed, in a copy."""

    def __init__(self) -> None:
        super().__init__()
        self.handed = []

    def forward(self, record):
        self.handed.append(record)
        return record.replace()


def chain_on_a_sphere(preset, **stages):
    scene, coarse = (
        each.to(torch.float32) for each in small_scene(num_views=4, width=32, num_points=12)
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


def assert_same(mesh, other):
    for name in ("vertices_world", "faces", "normals_world", "albedo", "confidence"):
        assert torch.equal(getattr(mesh, name), getattr(other, name))


@pytest.mark.parametrize(("preset", "behind"), GAPS)
def test_a_module_between_two_stages_is_handed_their_record_and_changes_no_bit(preset, behind):
    chain, views = chain_on_a_sphere(preset)
    stage, mine, usual = getattr(chain, behind), Mine(), chain.running()

    class OneMore(Running):
        """Runs as `passes` does with a line more: ``seen = run(mine, seen)``."""

        def __call__(self, called, *inputs, **named):
            record = super().__call__(called, *inputs, **named)
            return super().__call__(mine, record) if called is stage else record

    chain.running = lambda: OneMore(names=usual.names, store=None, put_off=usual.put_off)
    assert_same(chain(views).mesh, without(preset))
    assert mine.handed


@pytest.mark.parametrize("preset", SETTINGS)
def test_a_module_before_the_factorization_may_come_with_it_by_the_constructor(preset):
    mine = Mine()
    chain, views = chain_on_a_sphere(preset, factorize=nn.Sequential(mine, pt.Factorize()))
    assert_same(chain(views).mesh, without(preset))
    assert isinstance(mine.handed[0], pt.PatchViews)
