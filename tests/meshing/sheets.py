"""Square sheets of faces."""

import torch
from torch import Tensor


def sheet_of(side: int, bend: float) -> tuple[Tensor, Tensor]:
    """Return vertices and faces of a sheet of unit spacing, bent along x, that faces -z."""
    row, column = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    x, y = column.flatten().double(), row.flatten().double()
    vertices = torch.stack([x, y, bend * x * x], dim=1)
    here = (row[:-1, :-1] * side + column[:-1, :-1]).flatten()
    right, below, across = here + 1, here + side, here + side + 1
    faces = torch.cat(
        [torch.stack([here, below, across], dim=1), torch.stack([here, across, right], dim=1)]
    )
    return vertices, faces
