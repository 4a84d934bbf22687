"""The evaluation protocol of the DTU multi-view stereo set of 2014, as in its code."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_bench.truth import DtuProtocol
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import InputError

# Minimum size of a batch of points.
_BATCH = 100_000


def thin(
    points: Float[Tensor, "point 3"], distance: float, generator: torch.Generator
) -> Int[Tensor, " kept"]:
    """Thin points in random order: keep a point if no kept point is within ``distance``.

    Done in batches: kept points remove neighbours in a batch, which is then thinned separately.

    Returns:
        Indices of the kept points, in the order of processing.

    Source: Jensen et al., CVPR 2014, supplementary code.
    """
    positions = points.detach().cpu().double()
    order = torch.randperm(len(positions), generator=generator)
    kept = order[:0]
    while len(order):
        # As large as the kept set, so that few trees are built.
        batch, order = order.tensor_split([max(_BATCH, len(kept))])
        if len(kept):
            nearest, _ = cKDTree(positions[kept].numpy()).query(
                positions[batch].numpy(), distance_upper_bound=np.nextafter(distance, np.inf)
            )
            batch = batch[torch.from_numpy(nearest > distance)]
        kept = torch.cat([kept, batch[_thinned(positions[batch], distance)]])
    return kept


def _thinned(positions: Float[Tensor, "point 3"], distance: float) -> Bool[Tensor, " point"]:
    """Keep each point, first to last, without an earlier kept neighbour.

    A round keeps the points without an earlier undecided neighbour, and drops their
    neighbours; the result is the same as one by one.
    """
    undecided = np.ones(len(positions), dtype=bool)
    kept = np.zeros(len(positions), dtype=bool)
    pairs = cKDTree(positions.numpy()).query_pairs(distance, output_type="ndarray")
    first, second = np.sort(pairs, axis=1).T
    while undecided.any():
        preceded = np.zeros(len(positions), dtype=bool)
        preceded[second] = True
        chosen = undecided & ~preceded
        kept |= chosen
        undecided &= ~chosen
        undecided[second[chosen[first]]] = False
        open_pairs = undecided[first] & undecided[second]
        first, second = first[open_pairs], second[open_pairs]
    return torch.from_numpy(kept)


# Of the published code, in millimetres: the density of points, the distance from which a point
# is an outlier, and the side of the cells in which it searches for neighbours.
THINNING_MM, CAP_MM, _CELL_MM = 0.2, 20.0, 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DtuFigures(Record):
    """Figures of the protocol, in millimetres.

    Attributes:
        mean_accuracy: From the result to the scan, inside the observability mask.
        mean_completeness: From the scan above the table to the result.
        points: Of the result after thinning.
        evaluated: Points of the result inside the mask.
        evaluated_true: Points of the scan above the table.
        capped_fraction: Fraction of the evaluated points 20 mm off or more, which are excluded.
    """

    mean_accuracy: float
    median_accuracy: float
    mean_completeness: float
    median_completeness: float
    overall: float
    points: int
    evaluated: int
    evaluated_true: int
    capped_fraction: float
    capped_fraction_true: float


def dtu_figures(
    mesh: Mesh, scan: Float[Tensor, "point 3"], protocol: DtuProtocol, generator: torch.Generator
) -> DtuFigures:
    """Evaluate a result by the protocol.

    The vertices, and points on the faces, are thinned in random order until no two are within
    0.2 mm. Distances are between points. Accuracy is over the result's points in voxels
    of the observability mask; completeness over the scan's points above the plane of the
    table. Distances of 20 mm and more are excluded, and so are points outside the cells
    with which the code covers the bounding box.

    Args:
        mesh: In the frame of the set, millimetres.
        scan: The set's points, already thinned.

    Raises:
        InputError: No point of the result is inside the mask and near the scan, or no point
            of the scan near the result.

    Source: Jensen et al., CVPR 2014; the Matlab code that comes with the set.
    """
    dense = supersample(mesh, THINNING_MM)
    points = dense[thin(dense, THINNING_MM, generator)]
    truth = scan.detach().cpu().double()
    evaluated = points[observed(points, protocol)]
    plane = protocol.plane.to(truth)
    evaluated_true = truth[truth @ plane[:3] + plane[3] > 0]
    accuracy = _near(evaluated, truth, protocol)
    completeness = _near(evaluated_true, points, protocol)
    if len(accuracy) == 0 or len(completeness) == 0:
        raise InputError(
            f"{len(evaluated)} of {len(points)} points of the result are in the observability "
            f"mask, {len(accuracy)} of these within {CAP_MM:g} mm of the scan; "
            f"{len(completeness)} of the scan's points are as near to the result. Needed: a result "
            "in the frame and the millimetres of the set. Align it by its cameras first."
        )
    return DtuFigures(
        mean_accuracy=float(accuracy.mean()),
        median_accuracy=float(accuracy.median()),
        mean_completeness=float(completeness.mean()),
        median_completeness=float(completeness.median()),
        overall=float(accuracy.mean() + completeness.mean()) / 2,
        points=len(points),
        evaluated=len(evaluated),
        evaluated_true=len(evaluated_true),
        capped_fraction=1 - len(accuracy) / len(evaluated),
        capped_fraction_true=1 - len(completeness) / len(evaluated_true),
    )


def observed(points: Float[Tensor, "point 3"], protocol: DtuProtocol) -> Bool[Tensor, " point"]:
    """Return whether points are in a voxel of the observability mask."""
    mask = protocol.obs_mask.cpu()
    lower = protocol.bounding_box[0].to(points)
    # Halves round up, as in Matlab; torch rounds them to even numbers.
    voxel = ((points - lower) / protocol.resolution + 0.5).floor().long()
    shape = torch.tensor(mask.shape)
    inside = ((voxel >= 0) & (voxel < shape)).all(dim=1)
    x, y, z = torch.where(inside[:, None], voxel, 0).unbind(dim=1)
    return inside & mask[x, y, z]


def supersample(mesh: Mesh, distance: float) -> Float[Tensor, "point 3"]:
    """Return the vertices, and the published grid on each face, about ``distance`` apart.

    With edges ``v1, v2`` of twice-area ``A``, it has ``n_i = floor(|v_i| / (distance
    sqrt(|v1||v2| / A)))`` steps along ``v_i``, its points at half steps. A face too small for
    a step has only its vertices.
    """
    vertices = mesh.vertices_world.detach().cpu().double()
    faces = mesh.faces.cpu()
    if len(faces) == 0:
        return vertices
    a, b, c = vertices[faces].unbind(dim=1)
    v1, v2, area = b - a, c - a, face_normals(vertices, faces).norm(dim=1)
    l1, l2 = v1.norm(dim=1), v2.norm(dim=1)
    step = distance * (l1 * l2 / area).sqrt()
    n1, n2 = (l1 / step).floor(), (l2 / step).floor()
    usable = ((area > 0) & (n1 > 0) & (n2 > 0)).nonzero()[:, 0]
    n1, n2 = n1[usable].long(), n2[usable].long()
    counts = (n1 + 1) * (n2 + 1)
    total = float(counts.double().sum())
    # The sets' objects have some ten million points; a hundred million take gigabytes.
    if total > 2e8:
        raise InputError(
            f"points {distance:g} apart on the faces would be about {total / 2:.1g}; needed: at "
            "most 1e+08. Is the result in the millimetres of the set? Align it "
            "by its cameras first."
        )
    face = torch.arange(len(usable)).repeat_interleave(counts)
    offset = torch.arange(len(face)) - (counts.cumsum(0) - counts)[face]
    k1 = (offset // (n2[face] + 1) + 0.5) / n1[face]
    k2 = (offset % (n2[face] + 1) + 0.5) / n2[face]
    inside = k1 + k2 < 1
    chosen = usable[face[inside]]
    subdivision = a[chosen] + k1[inside, None] * v1[chosen] + k2[inside, None] * v2[chosen]
    return torch.cat([vertices, subdivision])


def _near(
    points: Float[Tensor, "point 3"], others: Float[Tensor, "other 3"], protocol: DtuProtocol
) -> Float[Tensor, " near"]:
    """Return distances below the cap from points inside the cells to the nearest other point."""
    lower, upper = protocol.bounding_box.to(points)
    reach = lower + _CELL_MM * (((upper - lower) / _CELL_MM).floor() + 1)
    inside = points[((points >= lower) & (points < reach)).all(dim=1)]
    if len(inside) == 0 or len(others) == 0:
        return inside.new_zeros(0)
    nearest, _ = cKDTree(others.numpy()).query(inside.numpy(), distance_upper_bound=CAP_MM)
    distance = torch.from_numpy(np.asarray(nearest))
    return distance[distance < CAP_MM]
