import mmap

import pytest
from probes import small_scene

import pimper_torch as pt
from pimper_torch.errors import ConfigError, ReconstructionError
from pimper_torch.memory import bytes_of, require_memory, resident_bytes
from pimper_torch.patches.decompose import Decompose


@pytest.mark.parametrize(("text", "size"), [("4GB", 4e9), ("800 mb", 8e8), ("", float("inf"))])
def test_sizes_are_read(text, size):
    assert bytes_of(text) == size


@pytest.mark.parametrize("text", ["4", "GB", "-1GB", "4 TB", "4GB or so"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ConfigError, match=r"max_memory is .* such as 4GB"):
        pt.load_config("default", {"max_memory": text})


def test_a_run_that_would_take_more_than_it_may_is_refused_with_what_it_needs():
    scene, coarse = small_scene(num_views=6, width=64)
    patches = Decompose()(coarse, scene.cameras)
    require_memory(float("inf"), patches, 0.5, 1.0)
    require_memory(resident_bytes() + 1e9, patches, 0.5, 1.0)
    with pytest.raises(ReconstructionError, match=r"in all.*by a factor of 0\.\d+ a side"):
        require_memory(resident_bytes() + 2e6, patches, 0.5, 1.0)
    with pytest.raises(ReconstructionError, match="photographs alone"):
        require_memory(1e6, patches, 0.5, 1.0)


def test_what_is_held_is_what_was_allocated():
    before = resident_bytes()
    with mmap.mmap(-1, 100_000_000) as block:  # of the system, whatever the process has free
        for page in range(0, len(block), mmap.PAGESIZE):
            block[page] = 1
        assert 8e7 < resident_bytes() - before < 1.2e8
