"""Training through the chain: camera offsets, the exponent of a response, a network for normals.

python benchmarks/studies/training.py CAPTURE [--tasks cameras response normals] [--steps 10]

CAPTURE is a folder from ``pimper render potatoes --num-views 8 --width 240 --height 180``.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize, pad
from torch.optim.lr_scheduler import CosineAnnealingLR

import pimper_torch as pt
from pimper_torch.chains.prepare import Prepared
from pimper_torch.data import Capture, read_capture
from pimper_torch.losses import well_visible

Progress = Iterator[tuple[Tensor, str, torch.optim.Optimizer]]
"""The loss of each step, the parameters in words, and what moves them after that."""


def of_cameras(chain: pt.Chain, prepared: Prepared, truth: Capture) -> Progress:
    """Train sideways offsets of 0.01 units, of all cameras but the first two, to zero."""
    scene, loss = prepared.scene, pt.losses.ConsistencyLoss()
    others = scene.views.num_views - 2
    start = torch.randn(others, 2, generator=torch.Generator().manual_seed(0))
    offset = nn.Parameter(0.01 * normalize(start, dim=1))
    optimizer = torch.optim.Adam([offset], lr=2e-3, betas=(0.7, 0.9))

    def moved(kept: Prepared) -> Prepared:
        cameras = scene.cameras.retract(pad(offset, (0, 4, 2, 0)))
        return kept.replace(scene=scene.replace(cameras=cameras))

    with torch.no_grad():
        frozen = next(chain.steps(moved(prepared))).frozen()
    visible = None
    while True:
        (step,) = chain.steps(moved(frozen))
        visible = loss.visible(step.surface, step.scene) if visible is None else visible
        value = loss(step.surface, step.scene, visible)
        yield value, f"{float(offset.detach().norm(dim=1).mean()):.5f} units", optimizer


def of_response(chain: pt.Chain, prepared: Prepared, truth: Capture) -> Progress:
    """Train the exponent of photographs that were encoded with 1 / 2.2, from 1 on."""
    scene, loss = prepared.scene, pt.losses.PhotometricLoss()
    encoded = scene.views.images.clamp(1e-4, 1) ** (1 / 2.2)
    logarithm = nn.Parameter(torch.zeros(()))
    optimizer = torch.optim.Adam([logarithm], lr=0.2, betas=(0.7, 0.9))

    def decoded() -> pt.SparseScene:
        return scene.replace(views=scene.views.replace(images=encoded ** logarithm.exp()))

    with torch.no_grad():
        first = next(chain.steps(prepared.replace(scene=decoded())))
    frozen, visible = first.frozen(), None
    while True:
        (step,) = chain.steps(frozen.replace(scene=decoded()))
        visible = loss.visible(step.surface, step.scene) if visible is None else visible
        value = loss(step.surface, step.scene, visible)
        yield value, f"exponent {float(logarithm.detach().exp()):.3f}", optimizer


def of_normals(chain: pt.Chain, prepared: Prepared, truth: Capture) -> Progress:
    """Train a small network from scratch to the normals of the surface, whose prior it is."""
    if truth.normals is None:
        raise SystemExit(f"{truth.name}: no true normals; needed: maps as of `pimper render`.")
    scene, true = prepared.scene, truth.normals
    torch.manual_seed(0)
    network = nn.Sequential(
        nn.Conv2d(3, 16, 5, 2, 2), nn.SiLU(), nn.Conv2d(16, 32, 3, 2, 1), nn.SiLU(),
        nn.Conv2d(32, 32, 3, 2, 1), nn.SiLU(), nn.Conv2d(32, 3, 3, 1, 1),
    )  # fmt: skip
    optimizer = torch.optim.Adam(network.parameters(), lr=4e-3, betas=(0.7, 0.9))
    with torch.no_grad():
        first = next(chain.steps(prepared))
    frozen, visible = first.frozen(), well_visible(first.surface, scene.cameras)

    def facing(image: Tensor) -> Tensor:
        found = interpolate(network(image), image.shape[-2:], mode="bilinear")
        return normalize(found - image.new_tensor([0, 0, 1])[:, None, None], dim=1)

    while True:
        prior = pt.priors_of(facing, scene, "normals", axes="opencv", error_deg=20.0)
        assert isinstance(prior, pt.NormalPrior)
        own = scene.replace(views=scene.views.replace(priors=(prior,)))
        (step,) = chain.steps(frozen.replace(scene=own))
        value = pt.losses.NormalLoss(prior)(step.surface, scene, visible)
        known = true.variance.isfinite() & prior.variance.isfinite()
        cosine = (true.normals * prior.normals.detach()).sum(dim=-1)[known].clamp(-1, 1)
        yield value, f"{float(cosine.arccos().rad2deg().mean()):.1f} degrees", optimizer


TASKS = {"cameras": of_cameras, "response": of_response, "normals": of_normals}


def main() -> None:
    """Print the loss and the parameters of every step of the tasks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--steps", type=int, default=10)
    options = parser.parse_args()
    truth = read_capture(options.capture)
    if truth.scene is None:
        raise SystemExit(f"{options.capture}: no cameras; needed: a rendered capture.")
    chain = pt.load_chain("training")
    prepared = chain.prepare(truth.scene)
    print("| task | step | loss | parameters | CPU s |\n|---|--:|--:|--:|--:|")  # noqa: T201
    for name in options.tasks:
        losses: list[float] = []
        began, schedule = time.process_time(), None
        for number, (loss, found, optimizer) in enumerate(TASKS[name](chain, prepared, truth)):
            losses.append(loss.item())
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            now = time.process_time()
            cells = name, number, f"{losses[-1]:.5f}", found, f"{now - began:.1f}"
            print("|", *(f"{cell} |" for cell in cells), flush=True)  # noqa: T201
            began = now
            if number == options.steps:
                break
            schedule = schedule or CosineAnnealingLR(optimizer, options.steps)
            optimizer.step()
            schedule.step()
        falls = sum(after < earlier for earlier, after in pairwise(losses))
        print(f"\n{name}: the loss falls in {falls} of {options.steps} steps\n")  # noqa: T201


if __name__ == "__main__":
    main()
