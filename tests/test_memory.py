import mmap
from contextlib import suppress

import pytest
from probes import small_scene

import pimper_torch as pt
from pimper_torch.chains.fusion_memory import largest_problem
from pimper_torch.runtime.config import bytes_of
from pimper_torch.runtime.errors import ConfigError, ReconstructionError
from pimper_torch.runtime.memory import resident_bytes
from pimper_torch.stages.patches.decompose import Decompose


@pytest.mark.parametrize(("text", "size"), [("4GB", 4e9), ("800 mb", 8e8), ("", float("inf"))])
def test_sizes_are_read(text, size):
    assert bytes_of(text) == size


@pytest.mark.parametrize("text", ["4", "GB", "-1GB", "4 TB", "4GB or so"])
def test_an_invalid_size_is_refused(text):
    with pytest.raises(ConfigError, match=r"max_memory is .* such as 4GB"):
        pt.load_config("default", {"max_memory": text})


def test_memory_decides_between_whole_blockwise_and_no_fusion(monkeypatch):
    scene, coarse = small_scene(num_views=6, width=64)
    patches = Decompose()(coarse, scene.cameras)
    assert largest_problem(float("inf"), patches, 0.5, 1.0) == float("inf")
    assert largest_problem(resident_bytes() + 1e9, patches, 0.5, 1.0) == float("inf")
    monkeypatch.setattr("pimper_torch.chains.fusion_memory.resident_bytes", lambda: 1e5)
    with pytest.raises(
        ReconstructionError, match=r"by blocks.*in total.*by a factor of 0\.\d+ per side"
    ):
        largest_problem(2e5, patches, 0.5, 1.0)
    with pytest.raises(ReconstructionError, match="photographs alone"):
        largest_problem(9e4, patches, 0.5, 1.0)
    found = []
    for step in range(100):
        limit = 1e5 * 1.1**step
        with suppress(ReconstructionError):
            found.append(limit / largest_problem(limit, patches, 0.5, 1.0))
    # Fractions of the limit per block vertex: zero once everything fits, at larger limits.
    first = next(index for index, part in enumerate(found) if part == 0)
    assert first > 0
    assert not any(found[first:])
    assert all(part / found[0] in (0.25, 0.5, 1, 2, 4) for part in found[:first])


def test_resident_memory_grows_by_the_allocation():
    before = resident_bytes()
    with mmap.mmap(-1, 100_000_000) as block:  # from the system, not from the heap
        for page in range(0, len(block), mmap.PAGESIZE):
            block[page] = 1
        assert 8e7 < resident_bytes() - before < 1.2e8
