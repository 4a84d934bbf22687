"""Train the network that reads cues about the object's silhouette.

Run as ``python benchmarks/studies/train_silhouettes.py OUT --meshes FILE ...``. Random captures are
rendered with their truth, cut as without the network, and their maps are stored in
``OUT/captures``. ``OUT/silhouettes.safetensors`` has the weights, and ``OUT/silhouettes.json``
their record. An interrupted run continues where it was.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, interpolate

from pimper_bench.scenes.random_captures import render_random
from pimper_torch.records import SparseScene
from pimper_torch.stages.silhouettes.cues import cues_of
from pimper_torch.stages.silhouettes.cuts import cut_in_iterations
from pimper_torch.stages.silhouettes.evidence import MAPS, Evidence
from pimper_torch.stages.silhouettes.network import SilhouetteNetwork
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig

LEVELS = 42.0  # stored levels for a unit of a map, between -3 and 3
TESTS = 100_000  # seed of the first capture to test on
GROUPS = sorted(set(MAPS.values()))
PLANE = ("light", "texture", "plane")


def main() -> None:
    """Render captures, train, and write weights and record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--meshes", type=Path, nargs="*", default=[], help="bodies to train on")
    parser.add_argument("--held-out", type=Path, nargs="*", default=[], help="bodies to test on")
    parser.add_argument("--captures", type=int, default=160, help="to train on")
    parser.add_argument("--tests", type=int, default=16, help="captures to test on")
    parser.add_argument("--views", type=int, default=14, help="of each capture")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 360), help="of its photographs")
    parser.add_argument("--minutes", type=float, default=90, help="of a processor")
    parser.add_argument("--only", choices=("render", "train"), help="do a part")
    parser.add_argument("--part", type=int, nargs=2, default=(0, 1), metavar=("REST", "OF"))
    options = parser.parse_args()
    folder = options.out / "captures"
    folder.mkdir(parents=True, exist_ok=True)
    seeds, tests = range(options.captures), range(TESTS, TESTS + options.tests)
    rest, of = options.part
    mine = [seed for seed in (*tests, *seeds) if seed % of == rest]
    for seed in mine if options.only != "train" else ():
        meshes = options.meshes if seed < TESTS else options.held_out
        store(folder, seed, meshes, options.views, *options.size)
    if options.only != "render":
        run = Run(options.out, options.minutes)
        run.train(lambda: existing(folder, seeds))
        run.finish(existing(folder, tests))


def store(
    folder: Path, seed: int, meshes: Sequence[Path], num_views: int, width: int, height: int
) -> None:
    """Render a capture, and store its maps."""
    if not (folder / f"{seed}.npy").exists():
        capture = render_random(seed, meshes, num_views=num_views, width=width, height=height)
        write(folder / f"{seed}.npy", maps_of(capture.scene), capture.foreground)
        say(f"capture {seed}")


@torch.no_grad()
def maps_of(scene: SparseScene) -> Iterator[Tensor]:
    """Return the maps of every view, with the cuts of all views if these have a common hull."""
    cues = cues_of(scene, SilhouetteConfig())
    evidence = Evidence.of(cues, cut_in_iterations(cues))
    return map(evidence.maps, range(cues.num_views))


def write(path: Path, maps: Iterator[Tensor], foreground: Tensor) -> None:
    """Store maps and the truth in levels from 0 to 255, whole or not at all."""
    part = path.with_suffix(".part")
    shape = (len(foreground), len(MAPS) + 1, *foreground.shape[1:])
    stored = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=shape)
    for view, (values, truth) in enumerate(zip(maps, foreground, strict=True)):
        stored[view, :-1] = (values * LEVELS + 127.5).round().clamp(0, 255).byte().numpy()
        stored[view, -1] = truth.numpy()
    del stored
    part.rename(path)


def existing(folder: Path, seeds: Sequence[int]) -> list[np.ndarray]:
    """Open the stored maps of captures."""
    paths = (folder / f"{seed}.npy" for seed in seeds)
    return [np.load(path, mmap_mode="r") for path in paths if path.exists()]


@dataclass
class Batches:
    """Random views of captures, varied."""

    captures: list[np.ndarray]
    generator: torch.Generator

    def draw(self, small: bool) -> tuple[Tensor, Tensor]:
        """Return maps and truth: of whole views at half their size, or of crops."""
        samples = [self._view(small) for _ in range(6 if small else 4)]
        maps, truth = (torch.stack(parts) for parts in zip(*samples, strict=True))
        return maps, truth

    def _number(self, below: int) -> int:
        return int(torch.randint(below, (1,), generator=self.generator))

    def _chance(self, probability: float) -> bool:
        return float(torch.rand(1, generator=self.generator)) < probability

    def _view(self, small: bool) -> tuple[Tensor, Tensor]:
        capture = self.captures[self._number(len(self.captures))]
        stored = capture[self._number(len(capture))]
        if not small:  # two thirds of both sides
            high, wide = (2 * side // 3 for side in stored.shape[1:])
            top, left = self._number(high // 2 + 1), self._number(wide // 2 + 1)
            stored = stored[:, top : top + high, left : left + wide]
        values = torch.from_numpy(np.array(stored)).float()
        if small:
            values = interpolate(values[None], scale_factor=0.5, mode="area")[0]
        if self._chance(0.5):
            values = values.flip(-1)
        maps, truth = (values[:-1] - 127.5) / LEVELS, values[-1]
        maps[0] += 0.3 * torch.randn(1, generator=self.generator)
        dropped = {group for group in GROUPS if self._chance(0.1)}
        if self._chance(0.12):
            dropped.update(PLANE)
        for index, group in enumerate(MAPS.values()):
            if group in dropped:
                maps[index] = 0
        return maps, truth


class Run:
    """Training that continues where it was interrupted."""

    def __init__(self, out: Path, minutes: float) -> None:
        self.out, self.minutes = out, minutes
        torch.manual_seed(0)
        self.network = SilhouetteNetwork()
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=2e-3, weight_decay=0.01)
        self.spent, self.steps, self.losses = 0.0, 0, []
        if (out / "state.pt").exists():
            state = torch.load(out / "state.pt", weights_only=True)
            self.network.load_state_dict(state["network"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.spent, self.steps, self.losses = state["spent"], state["steps"], state["losses"]

    @property
    def done(self) -> float:
        """Fraction of the time that is spent."""
        return self.spent / (60 * self.minutes)

    def train(self, captures: Callable[[], list[np.ndarray]]) -> None:
        """Train until the time is spent, on captures that may become more."""
        batches = Batches(captures(), torch.Generator().manual_seed(self.steps))
        self.network.train()
        recent: list[float] = []
        began = time.process_time()
        while self.done < 1:
            small = float(torch.rand(1)) < (0.7 if self.done < 0.5 else 0.3)
            for group in self.optimizer.param_groups:
                group["lr"] = 2e-3 * max(0.01, 0.5 * (1 + math.cos(math.pi * min(1, self.done))))
                group["lr"] *= min(1, (self.steps + 1) / 100)
            loss = loss_of(self.network, *batches.draw(small))
            self.optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimizer.step()
            self.steps += 1
            recent.append(float(loss.detach()))
            now = time.process_time()
            self.spent, began = self.spent + now - began, now
            if len(recent) == 100:
                self.losses.append(sum(recent) / len(recent))
                say(f"step {self.steps}, {self.done:.0%}, loss {self.losses[-1]:.4f}")
                recent = []
                batches.captures = captures()
                self.keep()
        self.keep()

    def keep(self) -> None:
        """Store the state, whole or not at all."""
        state = {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "spent": self.spent,
            "steps": self.steps,
            "losses": self.losses,
        }
        torch.save(state, self.out / "state.part")
        (self.out / "state.part").rename(self.out / "state.pt")

    def finish(self, tests: Sequence[np.ndarray]) -> None:
        """Write the weights and their record."""
        calibrate(self.network.eval(), tests)
        weights = {name: value.half() for name, value in self.network.state_dict().items()}
        save_file(weights, self.out / "silhouettes.safetensors")
        record: dict[str, object] = {"steps": self.steps, "minutes": self.minutes}
        record["loss of every hundredth step"] = [round(loss, 4) for loss in self.losses]
        rows, calibration = measured(self.network, tests)
        record |= {"overlap of cut and network": rows, "calibration": calibration}
        say("| cut | network |\n|--:|--:|")
        say("\n".join(f"| {cut:.3f} | {read:.3f} |" for cut, read in rows))
        (self.out / "silhouettes.json").write_text(json.dumps(record, indent=1) + "\n")


def loss_of(network: SilhouetteNetwork, maps: Tensor, truth: Tensor) -> Tensor:
    """Return cross entropy, and half of what the soft overlap lacks."""
    odds = network(maps)
    entropy = binary_cross_entropy_with_logits(odds, truth)
    inside = odds.sigmoid()
    both = (inside * truth).sum(dim=(1, 2))
    union = (inside + truth - inside * truth).sum(dim=(1, 2))
    return entropy + 0.5 * (1 - (both + 1) / (union + 1)).mean()


def calibrate(network: SilhouetteNetwork, captures: Sequence[np.ndarray]) -> None:
    """Scale and shift the odds of a network so that they are right on captures left out, if any."""
    samples = []
    network.calibration.copy_(torch.tensor([1.0, 0.0]))
    if not captures:
        return
    for stored in (view for capture in captures for view in capture[::3]):
        values = torch.from_numpy(np.array(stored)).float()
        with torch.no_grad():
            odds = network((values[None, :-1] - 127.5) / LEVELS)[0]
        samples.append(torch.stack([odds, values[-1]])[:, ::4, ::4].flatten(1))
    odds, truth = torch.cat(samples, dim=1)
    fit = torch.tensor([1.0, 0.0], requires_grad=True)
    optimizer = torch.optim.LBFGS([fit], max_iter=50)

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = binary_cross_entropy_with_logits(fit[0] * odds + fit[1], truth)
        value.backward()
        return value

    optimizer.step(loss)
    network.calibration.copy_(fit.detach())


@torch.no_grad()
def measured(
    network: SilhouetteNetwork, captures: Sequence[np.ndarray]
) -> tuple[list[tuple[float, float]], list[tuple[float, float, int]]]:
    """Return mean overlaps of captures, and predicted and true probabilities in ten bins.

    Overlaps are those of the cuts, and of the network's reading.
    """
    rows, counts = [], torch.zeros(10, 3, dtype=torch.float64)
    for capture in captures:
        of_views = []
        for stored in capture:
            values = torch.from_numpy(np.array(stored)).float()
            maps, truth = (values[None, :-1] - 127.5) / LEVELS, values[-1] > 0
            inside = network(maps)[0].sigmoid()
            masks = torch.stack([maps[0, -1] > 0, inside > 0.5])
            shared, either = (masks & truth).sum(dim=(1, 2)), (masks | truth).sum(dim=(1, 2))
            of_views.append(shared / either)
            index = (10 * inside).long().clamp_max(9).flatten()
            for column, value in enumerate((inside, truth, torch.ones_like(inside))):
                counts[:, column].index_add_(0, index, value.flatten().double())
        cut, read = torch.stack(of_views).mean(dim=0).tolist()
        rows.append((round(cut, 4), round(read, 4)))
    means = counts[:, :2] / counts[:, 2:].clamp_min(1)
    calibration = [
        (round(a, 3), round(b, 3), int(n))
        for (a, b), n in zip(means.tolist(), counts[:, 2].tolist(), strict=True)
    ]
    return rows, calibration


def say(line: str) -> None:
    """Print a line."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
