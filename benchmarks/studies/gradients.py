"""Compare the gradients of every stage and of the whole chain with finite differences.

    PYTHONPATH=tests/helpers python benchmarks/studies/gradients.py

Prints a Markdown table. On a small closed-form scene in float64, or on ``--scene``, a folder of
`pimper render`: the derivative of a random sum of each output along random directions of each
input, the ratio of autograd to central differences.
``--config`` and ``--scales`` choose the chain, ``--only`` the stages.
"""

import argparse
import sys
import warnings
from pathlib import Path

import torch
from probes import probes, rendered_scene, small_scene

import pimper_torch as pt
from pimper_torch.runtime.errors import PimperWarning


def main() -> None:
    """Read the command line, check, print a row for each pair of input and output."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", default="default", help="preset or YAML file")
    parser.add_argument("--scene", type=Path, help="the closed-form one if not given")
    parser.add_argument("--scales", nargs="*", type=float, help="of the photographs")
    parser.add_argument("--only", nargs="*", default=[], help="stages, or chain")
    parser.add_argument("--directions", type=int, default=3, help="random ones of each input")
    parser.add_argument("--weights", type=int, default=2, help="random sums of each output")
    parser.add_argument("--steps", nargs=2, type=float, default=[1e-6, 1e-7], help="relative")
    parser.add_argument("--seed", type=int, default=5, help="of directions and sums")
    options = parser.parse_args()
    warnings.simplefilter("ignore", PimperWarning)
    changes = {} if options.scales is None else {"scales": options.scales}
    chain = pt.load_chain(options.config, changes)
    scene = rendered_scene(options.scene) if options.scene else small_scene()
    say("| stage | by | of | ratio | median | farthest from 1 | directions | jump or bend, % |")
    say("|---|---|---|--:|--:|--:|--:|--:|")
    for stage, probe in probes(chain, *scene).items():
        if options.only and stage not in options.only:
            continue
        found = probe.check(
            torch.Generator().manual_seed(options.seed),
            directions=options.directions,
            weights=options.weights,
            steps=tuple(options.steps),
        )
        for (source, target), check in found.items():
            if not bool(check.numeric.any()) and not bool(check.analytic.any()):
                continue  # they do not depend on one another
            told = f"{int(check.smooth.sum())} of {len(check.smooth)}"
            say(
                f"| {stage} | {source} | {target} | {check.ratio:.4f} | {check.median:.4f} | "
                f"{check.spread:.4f} | "
                f"{told} | {100 * check.jumped:.1f} |"
            )


def say(line: str) -> None:
    """Write a line of the table at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
