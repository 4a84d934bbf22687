"""Figures over the pixels that all methods of a scene cover.

A method that leaves out what is hard has small errors on what it covers. Beside each method's
own coverage, all are therefore compared where none has a hole.
"""

from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.evidence.bench.rows import Row
from pimper_torch.evidence.metrics.in_view import figures_of, meet_truth
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import Capture

Covered = Bool[Tensor, "height width"]


def with_common(
    rows: Sequence[Row], covered: Sequence[Covered | None], meshes: Sequence[Path], maps: Capture
) -> list[Row]:
    """Add figures over the pixels that all methods cover to the rows of a scene.

    Args:
        covered: True where rays of the view meet truth and method; ``None`` for methods
            without a surface, which limit no other.
        meshes: The surfaces as files, in the frame of the truth.
        maps: The truth in that view alone.
    """
    known = [one for one in covered if one is not None]
    if not known:
        return list(rows)
    common = reduce(torch.logical_and, known)
    return [
        row if own is None else _with_common(row, path, common, maps)
        for row, own, path in zip(rows, covered, meshes, strict=True)
    ]


def _with_common(row: Row, path: Path, common: Covered, maps: Capture) -> Row:
    identity = torch.eye(4, dtype=torch.float64)
    mesh = read_mesh(path)
    met = meet_truth(mesh, identity, maps, 0)
    assert met is not None  # as when it was measured
    met = met.only(common)
    fraction = 100 * met.coverage
    if not met.both.any():
        return row.replace(common_percent=fraction)
    figures = figures_of(met, mesh, identity, maps, 0)
    normals, shape = figures.transferred_normals, figures.shape_normals
    return row.replace(
        common_percent=fraction,
        common_relative_error=figures.relative_error,
        common_mean_normal_deg=normals.mean_deg if normals else None,
        common_median_normal_deg=normals.median_deg if normals else None,
        common_mean_shape_normal_deg=shape.mean_deg if shape else None,
        common_median_shape_normal_deg=shape.median_deg if shape else None,
    )
