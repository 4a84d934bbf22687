"""Connected components of a raster without any anchor: each has a free constant."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.topology import graph_components


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeComponents:
    """The connected components without anchor, and their pixels.

    Attributes:
        pixel: Indices of the pixels of all free components, row by row.
        root: One pixel of each component.
        size: Pixels of each component.
    """

    pixel: Int[Tensor, " member"]
    component: Int[Tensor, " member"]
    root: Int[Tensor, " component"]
    size: Float[Tensor, " component"]

    def centered(self, heights: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Subtract from each free component its mean. Its own transpose; differentiable."""
        if not len(self.root):
            return heights
        part = heights[self.pixel]
        mean = heights.new_zeros(len(self.root)).index_add(0, self.component, part) / self.size
        return heights.index_add(0, self.pixel, -mean[self.component])

    def rooted(self, heights: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Subtract from each free component the height of its root."""
        part = heights[self.pixel] - heights[self.root][self.component]
        return heights.index_copy(0, self.pixel, part)

    def pinned(self, diagonal: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
        """Double the diagonal at one pixel of each free component: the matrix becomes definite.

        With a right-hand side of mean zero this fixes that pixel at 0 and changes nothing else.
        """
        return diagonal.index_add(0, self.root, diagonal[self.root])


def free_components(
    right: Bool[Tensor, "height steps_right"],
    down: Bool[Tensor, "steps_down width"],
    anchored: Bool[Tensor, "height width"],
) -> FreeComponents:
    """Find the components without anchor, but for single pixels.

    Args:
        right: Whether a pixel and the next in its row are connected.
        down: Whether it and the one below are.
        anchored: Whether a pixel's height is known.
    """
    label = _labels(right, down, anchored.shape)
    connected = torch.zeros_like(anchored)
    connected[:, 1:] |= right
    connected[:, :-1] |= right
    connected[1:] |= down
    connected[:-1] |= down
    count = int(label.max()) + 1 if label.numel() else 0
    pinned = anchored.new_zeros(count).index_put(
        (label[anchored.reshape(-1)],), anchored.new_ones(())
    )
    pixel = (connected.reshape(-1) & ~pinned[label]).nonzero()[:, 0]
    found, component = torch.unique(label[pixel], return_inverse=True)
    root = pixel.new_full((len(found),), label.numel())
    root = root.scatter_reduce(0, component, pixel, "amin")
    size = torch.bincount(component, minlength=len(found)).double()
    return FreeComponents(pixel=pixel, component=component, root=root, size=size)


def _labels(
    right: Bool[Tensor, "height steps_right"],
    down: Bool[Tensor, "steps_down width"],
    shape: tuple[int, ...],
) -> Int[Tensor, " pixel"]:
    count = shape[0] * shape[1]
    if bool(right.all()) and bool(down.all()):
        return torch.zeros(count, dtype=torch.long, device=right.device)
    pixel = torch.arange(count, dtype=torch.int32).reshape(shape)
    across, along = right.cpu(), down.cpu()
    one = torch.cat([pixel[:, :-1][across], pixel[:-1][along]])
    other = torch.cat([pixel[:, 1:][across], pixel[1:][along]])
    return graph_components(torch.stack([one, other], dim=1), count).long().to(right.device)
