r"""Where a surface ends: what sticks out of its borders.

A surface ends where its facets end, in teeth of their size, shreds and flaps. The distance from the
border, smoothed with a kernel that falls by e a length, is that length on a straight border, less
where the surface sticks out, and more in notches. Surface below it that photographs do not
determine is cut off, until there is none: borders move by their curvature, as by thresholded
diffusion (Merriman, Bence & Osher, Computational Crystal Growers Workshop, 1992), but inwards
alone, and never through surface that is determined.
"""

import math

import torch
from jaxtyping import Bool, Float
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.ground.geometry import topology
from pimper_torch.ground.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.ground.geometry.surfaces import side_lengths
from pimper_torch.ground.linalg.systems import solve_compressed
from pimper_torch.ground.shapes import FaceMask, Faces, PerVertex, Points, VertexMask, Vertices

# Lengths around vertices that may go, and from the border, on which the distance is smoothed. At
# full size 0.8 % of the faces that went with 8 stay, and a straight border is met exactly.
_REACH = 4.0
# Of the smoothed distance on a straight border, below which the surface sticks out. A choice: a
# right angle is rounded (0.59 at its tip), and arcs of a few lengths stay; with 0.9 a skull lost
# the edge of its teeth, with 0.55 flaps stay.
_STRAIGHT = 0.75


def protruding(
    vertices: Vertices, faces: Faces, length: float, unsure: FaceMask, edges: topology.FaceEdges
) -> FaceMask:
    """Find what sticks out of the borders of a surface and is not determined, until nothing does.

    Borders shorter than a circle of that radius are small holes, which do not count, and faces that
    are as large do not show what is narrower. A constant to autograd.

    Args:
        length: What sticks out is about as wide, or narrower; scene units.
        unsure: False for faces that photographs determine, which stay.
        edges: As for :func:`~pimper_torch.ground.geometry.topology.face_pairs`.
    """
    points, corners, unsure = vertices.detach().cpu(), faces.cpu(), unsure.cpu()
    out, (ends, index) = torch.zeros_like(unsure), (part.cpu() for part in edges)
    sides = side_lengths(points[corners[:: max(1, len(corners) // 100_000)]])
    if float(sides.median()) >= length:
        return out.to(faces.device)
    count, active = topology.face_counts(index, len(ends)), torch.unique(corners[unsure])
    # A skull's base that ends in flaps of four facets changes in 9.
    for _ in range(12):
        bare = ends[(count != 2) & (count > 0)]
        sides, loop = topology.boundary_loops(corners[~out], bare)
        around = torch.bincount(loop, (points[sides[:, 0]] - points[sides[:, 1]]).norm(dim=1))
        border = points[torch.unique(sides[(around >= math.tau * length)[loop]])]
        # In a plane what is further from the border has more than 0.76 of that.
        active = active[_near(points[active], border, 2.0 * length)]
        if len(active) == 0:
            break
        near = _near(points, points[active], _REACH * length)
        distance = torch.full_like(points[:, 0], torch.inf, dtype=torch.float64)
        distance[near] = _distance(points[near], border, _REACH * length)
        one, other, last = (distance.isfinite()[corner] & ~out for corner in corners.T)
        band, some = (one & other & last).nonzero()[:, 0], one | other | last
        used = topology.corners_of(corners, band, len(points))
        beside = topology.corners_of(corners, some.index_fill(0, band, False), len(points))[used]
        local = (used.cumsum(dim=0, dtype=torch.int32) - 1)[corners[band]]
        low = torch.zeros_like(used)
        low[used] = _smoothed(points[used], local, distance[used], length, beside) < _STRAIGHT
        low &= torch.zeros_like(low).index_fill(0, active, True)
        band = band[low[corners[band]].any(dim=1) & unsure[band]]
        if len(band) == 0:
            break
        out[band] = True
        count -= topology.face_counts(index[band], len(ends))
        active, gone = torch.unique(corners[unsure & ~out]), points[torch.unique(corners[band])]
        active = active[_near(points[active], gone, 2.0 * length)]
    return out.to(faces.device)


def _distance(
    points: Points, border: Float[Tensor, "border 3"], most: float
) -> Float[Tensor, " point"]:
    """Return the distance to the nearest point of a border; infinite where it is more than most."""
    tree = cKDTree(border.numpy())
    return torch.from_numpy(tree.query(points.numpy(), distance_upper_bound=most, workers=-1)[0])


def _near(points: Points, others: Float[Tensor, "other 3"], reach: float) -> Bool[Tensor, " point"]:
    """Find points about as near to others as that: others of a cell stand at its centre."""
    cell = reach / 8
    centres = cell * (torch.unique((others / cell).floor(), dim=0) + 0.5)
    return _distance(points, centres, reach).isfinite()


def _smoothed(
    vertices: Vertices, faces: Faces, values: PerVertex, length: float, beside: VertexMask
) -> PerVertex:
    """Smooth distances on a surface, reflected at its borders: a step of implicit diffusion.

    In lengths. Solved for the change from a straight border, which ends beside faces left out.
    """
    mesh = elements(vertices, faces)
    one = torch.ones_like(mesh.area)
    rows, columns, entries = cotangent_laplacian(mesh, length**2 * one, 0.01)
    mass, index = lumped_mass(mesh, one), torch.arange(mesh.count, dtype=faces.dtype)
    mass = torch.where(mass > 0, mass, mass.max())
    cells = tuple(torch.cat([some, index]).numpy() for some in (rows, columns))
    filled = torch.cat([entries, mass]).double().numpy()
    matrix = csr_array((filled, cells), shape=(mesh.count, mesh.count))
    straight = values + length * (-values / length).exp()
    source = (mass * values - torch.from_numpy(matrix @ straight.numpy())).masked_fill(beside, 0)
    what = "the smoothing of borders"
    change = solve_compressed(matrix, source[:, None], what=what, tolerance=1e-3)
    return (straight + change[:, 0]) / length
