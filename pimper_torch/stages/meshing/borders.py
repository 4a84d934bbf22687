r"""Protrusions of the borders of a surface.

A surface ends where its facets end, in teeth of their size, shreds and flaps. The distance to the
border, smoothed with a kernel that decays by a factor e per length, equals that length on a
straight border. It is smaller on protrusions and larger in notches. Surface with a smaller value
that photographs do not determine is cut off, repeatedly. Borders thus move by their curvature, as
by thresholded diffusion (Merriman, Bence & Osher, Computational Crystal Growers Workshop, 1992),
but only inwards, and never through determined surface.
"""

import math

import torch
from jaxtyping import Bool, Float
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.geometry import topology
from pimper_torch.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.geometry.surfaces import side_lengths
from pimper_torch.linalg.systems import solve_compressed
from pimper_torch.records.shapes import FaceMask, Faces, PerVertex, Points, VertexMask, Vertices

# Distance is smoothed within this many lengths around candidate vertices and from the border. At
# full size, 0.8 % of the faces removed with 8 stay, and a straight border is exact.
_REACH = 4.0
# Smoothed distance, relative to a straight border, below which the surface protrudes. A choice: a
# right angle is rounded (0.59 at its tip), and arcs of a few lengths stay; with 0.9 a skull lost
# the edge of its teeth, with 0.55 flaps stay.
_STRAIGHT = 0.75


def protruding(
    vertices: Vertices, faces: Faces, length: float, unsure: FaceMask, edges: topology.FaceEdges
) -> FaceMask:
    """Return undetermined faces that protrude from the borders, found repeatedly until none do.

    Borders shorter than a circle of radius ``length`` are small holes and are ignored. The result
    is empty if the median side of faces is not shorter than ``length``. Not differentiable.

    Args:
        length: Approximate largest width of a protrusion, scene units.
        unsure: False for faces that photographs determine, which stay.
        edges: As for :func:`~pimper_torch.geometry.topology.face_pairs`.
    """
    points, corners, unsure = vertices.detach().cpu(), faces.cpu(), unsure.cpu()
    out, (ends, index) = torch.zeros_like(unsure), (table.cpu() for table in edges)
    sides = side_lengths(points[corners[:: max(1, len(corners) // 100_000)]])
    if float(sides.median()) >= length:
        return out.to(faces.device)
    count, active = topology.face_counts(index, len(ends)), torch.unique(corners[unsure])
    # The base of a skull that ends in flaps of four facets takes 9 iterations.
    for _ in range(12):
        bare = ends[(count != 2) & (count > 0)]
        sides, loop = topology.boundary_loops(corners[~out], bare)
        around = torch.bincount(loop, (points[sides[:, 0]] - points[sides[:, 1]]).norm(dim=1))
        border = points[torch.unique(sides[(around >= math.tau * length)[loop]])]
        # In a plane, the smoothed distance beyond two lengths is above 0.76.
        active = active[_near(points[active], border, 2.0 * length)]
        if len(active) == 0:
            break
        near = _near(points, points[active], _REACH * length)
        distance = torch.full_like(points[:, 0], torch.inf, dtype=torch.float64)
        distance[near] = _distance(points[near], border, _REACH * length)
        a, b, c = (distance.isfinite()[corner] & ~out for corner in corners.T)
        band, touched = (a & b & c).nonzero()[:, 0], a | b | c
        used = topology.corners_of(corners, band, len(points))
        rim = topology.corners_of(corners, touched.index_fill(0, band, False), len(points))[used]
        local = (used.cumsum(dim=0, dtype=torch.int32) - 1)[corners[band]]
        low = torch.zeros_like(used)
        low[used] = _smoothed(points[used], local, distance[used], length, rim) < _STRAIGHT
        low &= torch.zeros_like(low).index_fill(0, active, True)
        band = band[low[corners[band]].any(dim=1) & unsure[band]]
        if len(band) == 0:
            break
        out[band] = True
        count -= topology.face_counts(index[band], len(ends))
        active, removed = torch.unique(corners[unsure & ~out]), points[torch.unique(corners[band])]
        active = active[_near(points[active], removed, 2.0 * length)]
    return out.to(faces.device)


def _distance(
    points: Points, border: Float[Tensor, "border 3"], most: float
) -> Float[Tensor, " point"]:
    """Return the distance to the nearest point of a border; infinite above ``most``."""
    tree = cKDTree(border.numpy())
    return torch.from_numpy(tree.query(points.numpy(), distance_upper_bound=most, workers=-1)[0])


def _near(points: Points, others: Float[Tensor, "other 3"], reach: float) -> Bool[Tensor, " point"]:
    """Return points within about ``reach`` of others, which are rounded to the centres of cells."""
    cell = reach / 8
    centres = cell * (torch.unique((others / cell).floor(), dim=0) + 0.5)
    return _distance(points, centres, reach).isfinite()


def _smoothed(
    vertices: Vertices, faces: Faces, values: PerVertex, length: float, rim: VertexMask
) -> PerVertex:
    """Return smoothed distances, over ``length``: a step of implicit diffusion on the surface.

    Borders reflect. Solved for the change from a straight border, which is 0 at the faces' rim.
    """
    mesh = elements(vertices, faces)
    ones = torch.ones_like(mesh.area)
    rows, columns, entries = cotangent_laplacian(mesh, length**2 * ones, 0.01)
    mass, index = lumped_mass(mesh, ones), torch.arange(mesh.count, dtype=faces.dtype)
    mass = torch.where(mass > 0, mass, mass.max())
    cells = tuple(torch.cat([axis, index]).numpy() for axis in (rows, columns))
    data = torch.cat([entries, mass]).double().numpy()
    matrix = csr_array((data, cells), shape=(mesh.count, mesh.count))
    straight = values + length * (-values / length).exp()
    source = (mass * values - torch.from_numpy(matrix @ straight.numpy())).masked_fill(rim, 0)
    name = "the smoothing of borders"
    change = solve_compressed(matrix, source[:, None], what=name, tolerance=1e-3)
    return (straight + change[:, 0]) / length
