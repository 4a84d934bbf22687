"""Passes of a chain warn once, with the figures of the last pass."""

import warnings

import torch
from probes import small_scene
from torch import nn

from pimper_torch.presets.load_chain import load_chain
from pimper_torch.records import Silhouettes
from pimper_torch.runtime.errors import caution
from pimper_torch.stages.meshing.repair import Repair
from pimper_torch.stages.stage import Given, Then


class Warner(nn.Module):
    """Returns its input, and emits other warnings in every pass."""

    def __init__(self, messages):
        super().__init__()
        self.left = list(messages)

    def forward(self, record):
        for message in self.left.pop(0):
            caution(message)
        return record


def iterations(messages):
    """Emit given warnings in each of three passes; return those that are shown."""
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=4, width=32))
    chain = load_chain(
        "default",
        silhouettes=Given(Silhouettes.everything(scene.views)),
        coarse_surface=Given(coarse),
        repair=Then(Repair(), Warner(messages)),
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(chain.steps(scene))
    ours = {message for some in messages for message in some}
    return [str(one.message) for one in caught if str(one.message) in ours]


def test_passes_warn_once_with_the_last_figures():
    assert iterations([["9 of 10", "no contours"], ["5 of 10"], ["3 of 10"]]) == ["3 of 10"]
