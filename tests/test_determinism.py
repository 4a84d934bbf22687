"""Same input, settings and seed: same bits, in one process and two, on one thread and several."""

import os
import subprocess
import sys
import warnings

import pytest
import torch

from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.runtime.store.digest import digest
from tests.test_chain import photographed, small_chain
from tests.threads import on_threads


def of_every_stage(preset):
    """Run a chain with known cameras; give the bits of what each stage returned.

    Stages that work on parts are called in the order in which threads come to them: what they
    gave is sorted.
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
def test_every_stage_gives_the_same_bits_again_and_on_any_number_of_threads(preset):
    first, *others = on_threads(lambda: of_every_stage(preset), 1, 2, 2)
    assert None not in (one for records in first.values() for one in records)
    assert {name for name, records in first.items() if records} >= {"warp", "decompose", "extract"}
    assert others == [first, first]


@pytest.mark.slow
def test_what_two_processes_give_has_the_same_bits():
    """As is shown for one process, of hashes of objects and addresses nothing may depend."""
    code = (
        "import hashlib, torch; torch.set_num_threads(2)\n"
        "from tests.test_determinism import of_every_stage\n"
        "print(hashlib.sha256(repr(of_every_stage('paper')).encode()).hexdigest())"
    )
    path = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    told = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | path,
        ).stdout
        for _ in range(2)
    }
    assert len(told) == 1
