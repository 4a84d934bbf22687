"""A small network that reads maps of cues and returns the log odds of the object.

Trained on rendered captures by ``benchmarks/studies/train_silhouettes.py``.

Source: Ronneberger, Fischer & Brox, U-Net, MICCAI 2015, for the architecture.
"""

from functools import cache
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad, pixel_shuffle, pixel_unshuffle, silu

from pimper_torch.records.shapes import Map, Maps
from pimper_torch.stages.silhouettes.evidence import MAPS, Evidence
from pimper_torch.stages.silhouettes.parallax import of_views

_WEIGHTS = Path(__file__).parents[2] / "data" / "silhouettes.safetensors"
_SIZE_PX = 480  # longer side of the maps in training
WIDTHS = (24, 40, 64, 96)  # channels at half the size, at a quarter, and so on


class _Block(nn.Module):
    """Two convolutions with normalization."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.norms = nn.ModuleList([nn.GroupNorm(8, outputs), nn.GroupNorm(8, outputs)])

    def forward(
        self, x: Float[Tensor, "batch _ height width"]
    ) -> Float[Tensor, "batch _ height width"]:
        """Return the features."""
        x = silu(self.norms[0](self.first(x)))
        return silu(self.norms[1](self.second(x)))


class SilhouetteNetwork(nn.Module):
    """A U-Net on half the maps' resolution, whose odds are calibrated after training.

    Args:
        maps: Number of maps.
        widths: Channels of every level; all must be multiples of 8.
    """

    calibration: Float[Tensor, "2"]

    def __init__(self, maps: int = len(MAPS), widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        self.enter = nn.Conv2d(4 * maps, widths[0], 1)
        self.down = nn.ModuleList(map(_Block, (widths[0], *widths), widths))
        self.across = nn.ModuleList(nn.Conv2d(high, low, 1) for low, high in pairwise(widths))
        self.up = nn.ModuleList(_Block(low, low) for low in widths[:-1])
        self.last = nn.Conv2d(widths[0], 4, 1)
        self.steps = 2 ** len(widths)
        self.register_buffer("calibration", torch.tensor([1.0, 0.0]))  # factor and summand of odds

    def forward(
        self, maps: Float[Tensor, "batch map height width"]
    ) -> Float[Tensor, "batch height width"]:
        """Return the log odds that a pixel shows the object. Differentiable."""
        height, width = maps.shape[-2:]
        x = pad(maps, (0, -width % self.steps, 0, -height % self.steps), mode="replicate")
        x, kept = self.enter(pixel_unshuffle(x, 2)), []
        for level, block in enumerate(self.down):
            x = block(avg_pool2d(x, 2) if level else x)
            kept.append(x)
        for level in reversed(range(len(self.up))):
            wide = interpolate(self.across[level](x), scale_factor=2.0, mode="nearest")
            x = self.up[level](kept[level] + wide)
        factor, summand = self.calibration
        return factor * pixel_shuffle(self.last(x), 2)[:, 0, :height, :width] + summand


def load_network(path: Path | str = _WEIGHTS) -> SilhouetteNetwork:
    """Load a trained network for inference, by default the package's own."""
    network = SilhouetteNetwork()
    network.load_state_dict({name: value.float() for name, value in load_file(path).items()})
    return network.eval().requires_grad_(False)


@cache
def own_network() -> SilhouetteNetwork:
    """Return the package's own network; loaded once, as a chain has no parameters of its own."""
    return load_network()


@torch.no_grad()
def read(evidence: Evidence, network: nn.Module) -> Maps:
    """Return the log odds of the object at the working size; not differentiable."""
    like = next(network.parameters(), torch.empty(0))

    def of_view(view: int) -> Map:
        maps = evidence.maps(view)[None]
        size = maps.shape[-2:]
        factor = min(1.0, _SIZE_PX / max(size))
        small = [max(1, round(factor * side)) for side in size]
        odds = network(interpolate(maps, small, mode="area").to(like))[:, None].to(maps)
        return interpolate(odds, size, mode="bilinear", align_corners=False)[0, 0]

    return of_views(of_view, evidence.cues.num_views)
