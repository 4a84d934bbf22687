"""Time and memory of gradients, for each stage and for the whole chain.

Cameras and masks are true. Each stage gets the inputs of the chain's last pass. It runs first
without gradients, then with gradients of all results (the sum of their squares) with respect to all
input tensors. Seconds are wall time, the better of two calls. Memory is the maximum growth of the
process during the call, where Linux reports it, and the total after it. Gradients that are not
finite are counted.
"""

import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from declared import Column, Figures, Place, Row, Study, Table, figure, listed, number
from probes import calls, stage_of
from torch import Tensor
from torch.utils import _pytree as pytree

import pimper_torch as pt
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.runtime.memory import release_memory

STAGES = ("warp", "factorize", "sweep", "fuse", "decompose", "the chain")


def tracked(arguments: Any) -> tuple[Any, list[Tensor]]:  # noqa: ANN401 - records and tuples of them
    """Return arguments whose floating-point tensors are leaves of a graph, and these."""
    leaves, spec = pytree.tree_flatten(arguments)
    fresh = {
        id(leaf): leaf.detach().clone().requires_grad_()
        for leaf in leaves
        if isinstance(leaf, Tensor) and leaf.is_floating_point()
    }
    return pytree.tree_unflatten([fresh.get(id(leaf), leaf) for leaf in leaves], spec), [
        *fresh.values()
    ]


def pulled_back(result: Any, inputs: list[Tensor]) -> list[Tensor]:  # noqa: ANN401
    """Return the gradients of the sum of squares of all finite values that a stage gives."""
    leaves = [leaf for leaf in pytree.tree_leaves(result) if isinstance(leaf, Tensor)]
    tracked = [leaf for leaf in leaves if leaf.requires_grad]
    if not tracked:
        return []  # constants to autograd
    sides = [torch.where(leaf.isfinite(), 2 * leaf, 0).detach() for leaf in tracked]
    found = torch.autograd.grad(tracked, inputs, sides, allow_unused=True)
    return [slope for slope in found if slope is not None]


def measured(work: Callable[[], Any]) -> tuple[float, float, float, Any]:
    """Return seconds, growth and peak of memory in gigabytes, and the result."""
    reset = Path("/proc/self/clear_refs")
    if reset.exists():
        release_memory()
        reset.write_text("5")  # the peak becomes the present size
    before, began = peak_gigabytes(), time.perf_counter()
    result = work()
    seconds, peak = time.perf_counter() - began, peak_gigabytes()
    return seconds, peak - before, peak, result


def peak_gigabytes() -> float:
    """Return the peak memory of the process, 0 if the system does not report it."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmHWM")), 0.0)


def cost(stage: Callable[..., Any], arguments: tuple[Any, ...]) -> Figures:
    """Measure a stage without gradients and with them."""
    given, inputs = tracked(arguments)

    def with_gradients() -> list[Tensor]:
        return pulled_back(stage(*given), inputs)

    stage(*arguments)  # loads kernels
    plain = [measured(lambda: stage(*arguments))[:3] for _ in range(2)]
    with_gradients()
    found = [measured(with_gradients) for _ in range(2)]
    slopes = found[-1][3]
    figures: Figures = {}
    for i, name in enumerate(("s", "GB more", "GB")):
        figures[name] = min(each[i] for each in plain)
        figures[f"{name} with"] = min(each[i] for each in found)
    figures["not finite"] = sum(int((~slope.isfinite()).sum()) for slope in slopes)
    return figures


def measure(place: Place, name: str) -> Figures:
    """Measure a stage on its inputs in the last pass, or the whole chain."""
    warnings.simplefilter("ignore", PimperWarning)
    scales = {"scales": [0.25] if place.tiny else [0.25, 0.5]}
    folder = place.scene("potatoes", num_views=8, width=240, height=180)
    views = pt.load_views(folder / "photos", masks=folder / "masks")
    chain = pt.load_chain("default", scales)
    scene = chain.reconstruct(views, folder / "truth" / "sparse")
    if name == "the chain":
        return cost(chain, (scene,))
    given = calls(chain, lambda: chain(scene))
    return cost(stage_of(chain, name), given[name])


def times(name: str) -> Column:
    """Return the column of how many times as much gradients take."""
    return Column("times", lambda row: number(row[f"{name} with"] / max(row[name], 1e-3), 1))


STUDY = Study(
    name="gradient_cost",
    rows={(name,): Row(measure=partial(measure, name=name)) for name in STAGES},
    tables=[
        Table(
            name="gradient-cost",
            document="benchmarks/README.md",
            lines=listed(
                ["stage"],
                [
                    figure("s", "s"),
                    figure("with", "s with"),
                    times("s"),
                    figure("GB more", "GB more"),
                    figure("with", "GB more with"),
                    figure("GB in all", "GB"),
                    figure("with", "GB with"),
                    figure("not finite", "not finite", 0),
                ],
            ),
        )
    ],
)
