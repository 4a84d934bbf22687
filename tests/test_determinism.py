"""Same input, settings and seed give the same bits, in any process and on any number of threads."""

import os
import subprocess
import sys
import warnings

import pytest
import torch

from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.store.digest import digest
from tests.test_chain import photographed, small_chain
from tests.threads import on_threads


def digests_of_stages(preset):
    """Run a chain with known cameras; return the digests of each stage's records.

    They are sorted: threads call stages that process parts in any order.
    """
    scene = photographed(Sphere(), 162, target=(0.0, 0.0, 1.0))
    chain = small_chain(preset, sparse_scene(scene, 150, torch.Generator().manual_seed(17)))
    found = {name: [] for name, _ in chain.named_children()}

    def keep(name):
        return lambda stage, given, record: found[name].append(digest(record))

    for name, stage in chain.named_children():
        stage.register_forward_hook(keep(name))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PimperWarning)
        chain(scene.views)
    return {name: sorted(records) for name, records in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_stages_are_reproducible_bit_for_bit_on_any_number_of_threads(preset):
    first, *others = on_threads(lambda: digests_of_stages(preset), 1, 2, 2)
    assert None not in (one for records in first.values() for one in records)
    assert {name for name, records in first.items() if records} >= {"warp", "decompose", "extract"}
    assert others == [first, first]


@pytest.mark.slow
def test_two_processes_give_the_same_bits():
    """Results must not depend on hashes and addresses of objects, which differ by process."""
    code = (
        "import hashlib, torch; torch.set_num_threads(2)\n"
        "from tests.test_determinism import digests_of_stages\n"
        "print(hashlib.sha256(repr(digests_of_stages('paper')).encode()).hexdigest())"
    )
    path = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    printed = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | path,
        ).stdout
        for _ in range(2)
    }
    assert len(printed) == 1
