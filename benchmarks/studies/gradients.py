"""The gradients of every stage and of the whole chain, compared with finite differences.

On a small closed-form scene in float64: the derivative of a random sum of each output along random
directions of each input, the ratio of autograd to central differences.
"""

import warnings
from functools import partial

import torch
from declared import Figures, Place, Row, Study, Table, figure, listed, said
from probes import probes, small_scene

import pimper_torch as pt
from pimper_torch.runtime.errors import PimperWarning

STAGES = ("factorize", "sweep", "fuse", "chain")
# The scene of the whole chain in `tests/test_gradients.py`: no step changes a discrete choice.
FEW = {"seed": 36, "num_views": 5, "width": 32, "num_points": 11}


def measure(place: Place, stage: str) -> Figures:
    """Check every output of a stage by every input that it depends on."""
    warnings.simplefilter("ignore", PimperWarning)
    whole = stage == "chain"
    scales = {"scales": [0.5, 1.0]} if whole else {"scales": [1.0]} if place.tiny else {}
    scene = small_scene(**FEW) if whole else small_scene()
    found = probes(pt.load_chain("default", scales), *scene)[stage].check(
        torch.Generator().manual_seed(5),
        directions=1 if place.tiny else 3,
        weights=2,
        steps=(1e-6, 1e-7),
    )
    checks = {
        pair: check
        for pair, check in found.items()
        if check.spread == check.spread and bool(check.numeric.any() or check.analytic.any())
    }
    (source, target), worst = max(checks.items(), key=lambda item: item[1].spread)
    medians = sorted(check.median for check in checks.values())
    return {
        "pairs": len(checks),
        "median": medians[len(medians) // 2],
        "farthest median": worst.median,
        "farthest": worst.spread,
        "worst": f"{target} by {source}",
    }


STUDY = Study(
    name="gradients",
    rows={(stage,): Row(measure=partial(measure, stage=stage)) for stage in STAGES},
    tables=[
        Table(
            name="gradients",
            document="benchmarks/README.md",
            lines=listed(
                ["stage"],
                [
                    figure("outputs by inputs", "pairs", 0),
                    figure("median ratio", "median", 4),
                    said("least accurate", "worst"),
                    figure("its median ratio", "farthest median", 4),
                    figure("farthest from 1", "farthest", 4),
                ],
            ),
        )
    ],
)
