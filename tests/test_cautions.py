"""What every round would warn of is said once, as the last round has it."""

import pytest
from probes import small_scene
from torch import nn

from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.errors import PimperWarning, caution, held
from pimper_torch.records import Silhouettes
from pimper_torch.stage import Given


class Stub(nn.Module):
    def __init__(self, work):
        super().__init__()
        self.work = work

    def forward(self, *_, **__):
        return self.work()


def iterations(messages):
    """A chain whose factorization warns of something else in every round."""
    chain, left = CoarseToFine(), list(messages)
    for name, _ in list(chain.named_children()):
        setattr(chain, name, Stub(object))

    def factorize():
        for message in left.pop(0):
            caution(message)

    scene, _ = small_scene()
    chain.silhouettes = Given(Silhouettes.everything(scene.views))
    chain.factorize = Stub(factorize)
    return list(chain.passes(chain.running(), scene, None, None))


def test_the_last_rounds_figures_are_said_once():
    with pytest.warns(PimperWarning) as caught:
        iterations([["9 of 10", "no contours"], ["5 of 10"], ["3 of 10"]])
    assert [str(warning.message) for warning in caught] == ["3 of 10"]


def test_what_the_last_round_has_mended_is_not_said(recwarn):
    iterations([["9 of 10"], [], []])
    assert not recwarn.list


def broken_round():
    with held():
        caution("3 of 10")
        raise ValueError("broken")


def test_a_round_that_fails_says_what_it_held_back():
    with pytest.warns(PimperWarning, match="3 of 10"), pytest.raises(ValueError, match="broken"):
        broken_round()


def test_outside_of_rounds_a_caution_comes_at_once(pytestconfig):
    with pytest.warns(PimperWarning, match="now") as caught:
        caution("now")
    if not pytestconfig.getoption("jaxtyping_packages"):  # which puts calls of its own between
        assert caught[0].filename == __file__
