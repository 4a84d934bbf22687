"""Time and memory of gradients, for each stage and for the whole chain.

    PYTHONPATH=tests/helpers python benchmarks/studies/gradient_cost.py SCENE [--only factorize]

SCENE is a folder of `pimper render`; cameras and masks are true. Each stage gets the inputs of the
chain's last pass. It runs first without gradients, then with gradients of all results (the sum of
their squares) with respect to all input tensors. Seconds are wall time, the better of two calls.
Memory is the maximum growth of the process during the call, where Linux reports it, and the total
after it. Gradients that are not finite are counted.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from probes import calls, stage_of
from torch import Tensor
from torch.utils import _pytree as pytree

import pimper_torch as pt
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.runtime.memory import release_memory

STAGES = ("warp", "factorize", "sweep", "fuse", "repair", "remesh", "decompose", "extract")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Seconds and gigabytes without gradients and with them, and gradients that are not finite."""

    seconds: tuple[float, float]
    gigabytes: tuple[float, float]
    in_all: tuple[float, float]
    not_finite: int
    gradients: int

    def row(self, name: str) -> str:
        """Return a row of the table."""
        (plain, tracked), (least, most) = self.seconds, self.gigabytes
        cells = [name, f"{plain:.2f}", f"{tracked:.2f}", f"{tracked / plain:.1f}"]
        cells += [f"{least:.2f}", f"{most:.2f}"]
        (least, most) = self.in_all
        cells += [f"{least:.2f}", f"{most:.2f}", f"{most / max(least, 1e-3):.1f}"]
        return "| " + " | ".join([*cells, f"{self.not_finite} of {self.gradients}"]) + " |"


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


def cost(stage: Callable[..., Any], arguments: tuple[Any, ...]) -> Cost:
    """Measure a stage."""
    given, inputs = tracked(arguments)

    def with_gradients() -> list[Tensor]:
        return pulled_back(stage(*given), inputs)

    stage(*arguments)  # loads kernels
    plain = [measured(lambda: stage(*arguments))[:3] for _ in range(2)]
    with_gradients()
    found = [measured(with_gradients) for _ in range(2)]
    slopes = found[-1][3]
    seconds, gigabytes, in_all = (
        (min(each[i] for each in plain), min(each[i] for each in found)) for i in range(3)
    )
    return Cost(
        seconds=seconds,
        gigabytes=gigabytes,
        in_all=in_all,
        not_finite=sum(int((~slope.isfinite()).sum()) for slope in slopes),
        gradients=sum(slope.numel() for slope in slopes),
    )


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--scales", nargs="+", type=float, default=[0.25, 0.5])
    parser.add_argument("--only", nargs="+", default=[*STAGES, "chain"])
    options = parser.parse_args()
    warnings.simplefilter("ignore", PimperWarning)
    views = pt.load_views(options.scene / "photos", masks=options.scene / "masks")
    load = pt.load_chain("default", {"scales": options.scales})
    scene = load.reconstruct(views, options.scene / "truth" / "sparse")
    given = calls(load, lambda: load(scene))
    say("| stage | s | with | times | GB more | with | GB in all | with | times | not finite |")
    say("|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for name in [name for name in STAGES if name in options.only and name in given]:
        say(cost(stage_of(load, name), given[name]).row(name))
    if "chain" in options.only:
        chain = pt.load_chain("default", {"scales": options.scales})
        say(cost(chain, (scene,)).row("chain"))


def say(line: str) -> None:
    """Write a line of the table at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
