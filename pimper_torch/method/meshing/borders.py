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
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.ground.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.ground.geometry.surfaces import side_lengths
from pimper_torch.ground.geometry.topology import boundary_loops, corners_of
from pimper_torch.ground.linalg.systems import solve_compressed
from pimper_torch.ground.shapes import FaceMask, Faces, PerVertex, Points, VertexMask, Vertices

# Lengths round faces that may go: with 5, the rounding of a right angle creeps along the border.
_REACH = 8.0
# Of the smoothed distance on a straight border, below which the surface sticks out. A choice: a
# right angle is rounded (0.59 at its tip), and arcs of a few lengths stay; with 0.9 a skull lost
# the edge of its teeth, with 0.55 flaps stay.
_STRAIGHT = 0.75


def protruding(vertices: Vertices, faces: Faces, length: float, unsure: FaceMask) -> FaceMask:
    """Find what sticks out of the borders of a surface and is not determined.

    Borders shorter than a circle of that radius are small holes, which do not count, and faces that
    are as large do not show what is narrower. A constant to autograd.

    Args:
        length: What sticks out is about as wide, or narrower; scene units.
        unsure: False for faces that photographs determine, which stay.
    """
    points, corners, unsure = vertices.detach().double().cpu(), faces.cpu(), unsure.cpu()
    marked = torch.zeros(len(faces), dtype=torch.bool)
    sides = side_lengths(points[corners[:: max(1, len(corners) // 100_000)]])
    if float(sides.median()) >= length or not bool(unsure.any()):
        return marked.to(faces.device)
    border = _long_borders(points, corners, length)
    loose = torch.unique(corners[unsure])
    loose = loose[_near(points[loose], points[border], _REACH * length)]
    if len(loose):
        near = _near(points, points[loose], _REACH * length)[corners].all(dim=1)
        inner = torch.zeros_like(points[:, 0], dtype=torch.bool)
        inner[corners[~near]] = True
        used, local = torch.unique(corners[near], return_inverse=True)
        marked[near] = _repeatedly(points[used], local, inner[used], length, unsure[near])
    return marked.to(faces.device)


def _repeatedly(
    vertices: Vertices, faces: Faces, inner: VertexMask, length: float, unsure: FaceMask
) -> FaceMask:
    """Cut off what sticks out until nothing does; borders along inner vertices are none.

    Only faces near a border can go, and after the first time only those near what was cut.
    """
    out, active = torch.zeros(len(faces), dtype=torch.bool), torch.ones_like(inner)
    smooth = torch.full_like(vertices[:, 0], length)
    # A skull's base that ends in flaps of four facets changes in 9.
    for _ in range(12):
        left = (~out).nonzero()[:, 0]
        border = _long_borders(vertices, faces[left], length)
        border = border[~inner[border]]
        active &= corners_of(faces, unsure & ~out, len(vertices))
        # In a plane what is further from the border has more than 0.76 of that.
        active[active.clone()] = _near(vertices[active], vertices[border], 2.0 * length)
        if not bool(active.any()):
            break
        near = _near(vertices, vertices[active], _REACH * length)
        left = left[near[faces[left]].all(dim=1)]
        used, local = torch.unique(faces[left], return_inverse=True)
        distance = _distance(vertices[used], vertices[border], torch.inf)
        smooth[used] = _smoothed(vertices[used], local, distance, length, smooth[used])
        some = (active & (smooth < _STRAIGHT * length))[faces[left]].any(dim=1) & unsure[left]
        if not bool(some.any()):
            break
        out[left[some]] = True
        gone = vertices[torch.unique(faces[left[some]])]
        # The kernel is 0.02 there.
        active = _near(vertices, gone, 4.0 * length)
    return out


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


def _long_borders(vertices: Vertices, faces: Faces, length: float) -> Int[Tensor, " border"]:
    """List the vertices of borders that are no small holes."""
    edges, loop = boundary_loops(faces)
    if len(loop) == 0:
        return loop
    sides = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1)
    around = sides.new_zeros(int(loop.max()) + 1).index_add(0, loop, sides)
    return torch.unique(edges[(around >= math.tau * length)[loop]])


def _smoothed(
    vertices: Vertices, faces: Faces, values: PerVertex, length: float, start: PerVertex
) -> PerVertex:
    """Smooth values on a surface, reflected at its borders: a step of implicit diffusion.

    Vertices without faces keep their values.
    """
    mesh = elements(vertices, faces)
    one = torch.ones_like(mesh.area)
    rows, columns, entries = cotangent_laplacian(mesh, length**2 * one, 0.01)
    mass, index = lumped_mass(mesh, one), torch.arange(mesh.count)
    mass = torch.where(mass > 0, mass, mass.max())
    cells = tuple(torch.cat([some, index]).int().numpy() for some in (rows, columns))
    matrix = csr_array((torch.cat([entries, mass]).numpy(), cells), shape=(mesh.count, mesh.count))
    sides, near = (mass * values)[:, None], start[:, None]
    what = "the smoothing of borders"
    return solve_compressed(matrix, sides, what=what, start=near)[:, 0]
