"""How a chain calls its stages."""

import pytest
from torch import nn

from pimper_torch.chains.running import ChainRun
from pimper_torch.runtime.errors import PimperWarning, caution


class Noting(nn.Module):
    """Returns its inputs as a list, and emits a warning at every call."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def forward(self, *given):
        self.calls += 1
        caution(f"call {self.calls}")
        return [*given]


@pytest.fixture
def stages():
    return {name: Noting() for name in ("warp", "factorize", "sweep", "fuse")}


def running(stages):
    return ChainRun(names={one: name for name, one in stages.items()}, store=None)


def test_only_the_last_pass_warns_unless_one_fails(stages):
    run = running(stages)
    with pytest.warns(PimperWarning) as caught:
        found = [run(stages["fuse"], *one) for one in run.passes((0.25, 0.5, 1.0))]
    assert found == [[0.25, False], [0.5, False], [1.0, True]]
    assert [str(one.message) for one in caught] == ["call 3"]

    def broken():
        caution("before it broke")
        raise ValueError("broken")

    next(run.passes((0.5, 1.0)))
    with pytest.warns(PimperWarning, match="before it broke"), pytest.raises(ValueError):  # noqa: PT011
        run(broken)
