"""A rival of the coarse surface: full tetrahedra after ray carving, by minimum cut.

Labatut, Pons & Keriven, Robust and efficient surface reconstruction from range data, CGF 28(8),
2009, with random points between the matched ones, so that facets also exist without matches. Space
outside the visual hull is empty: a mask contributes additional rays.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from scipy.spatial import Delaunay, cKDTree
from torch import Tensor

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.visual_hull import Hull
from pimper_torch.records import ContourPoints
from pimper_torch.stages.coarse.densify import DepthMaps
from pimper_torch.stages.coarse.oriented import OrientedPoints

# Capacities are integers there.
_UNIT = 100

# Places on a ray at which its tetrahedron is looked up, and the part of it, in deviations, where
# it may cross facets and pay.
_PLACES, _SPAN = 48, 4.0


def cut_surface(
    cloud: OrientedPoints,
    maps: DepthMaps,
    hull: Hull,
    contour: ContourPoints | None = None,
    *,
    max_points: int = 20_000,
    views_each: int = 3,
    seed: int = 0,
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Separate the tetrahedra that rays cross from those that they end on.

    Args:
        cloud: Matched points.
        maps: Which views see a point: those whose depth is the point's.
        hull: Contains the whole surface.
        contour: Points on silhouettes, observed by the view of their silhouette.
        max_points: Of the cloud; as many random ones come in between.
        views_each: Rays of each point, at most.
        seed: Of both.
    """
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(cloud.points_world), generator=generator)[:max_points]
    points = cloud.points_world[chosen].double()
    low, high = hull.corners_world.double()
    point, center = _rays(points.float(), maps, views_each)
    if contour is not None:
        point = torch.cat([point, len(points) + torch.arange(len(contour.ray))])
        center = torch.cat([center, maps.level.cameras.centers_world[contour.view]])
        points = torch.cat([points, contour.points_world.double()])
    random = low + (high - low) * torch.rand(
        8 * len(points), 3, generator=generator, dtype=torch.float64
    )
    random = random[hull.depth_of(random.float()) > -2 * hull.spacing][: len(points)]
    mesh = Delaunay(torch.cat([points, random]).numpy())
    tetrahedra, beside = torch.from_numpy(mesh.simplices).long(), torch.from_numpy(mesh.neighbors)
    corners = torch.from_numpy(mesh.points)[tetrahedra]
    distance, _ = cKDTree(points.numpy()).query(points.numpy(), k=5)
    sigma = 2 * float(np.median(distance[:, 1:]))
    arcs, source, sink = _votes(mesh, points[point], center.double(), sigma)
    empty = hull.depth_of(corners.mean(dim=1).float()) < 0
    source[empty.numpy()] += 1e6 / _UNIT
    # Tetrahedra that no ray crosses are full rather than empty, by half a ray's weight.
    untold = ~empty.numpy()
    untold[np.concatenate(arcs[:2]).astype(int)] = False
    sink[untold] += 0.5
    full = _cut(len(tetrahedra), arcs, _shapes(corners, beside.long()), source, sink)
    return _border(torch.from_numpy(mesh.points).float(), tetrahedra, beside.long(), full)


def _rays(
    points: Float[Tensor, "point 3"], maps: DepthMaps, most: int
) -> tuple[Int[Tensor, " ray"], Float[Tensor, "ray 3"]]:
    """List the cameras that see each point, by their depth maps."""
    cameras, (height, width) = maps.level.cameras, maps.valid.shape[-2:]
    count = torch.zeros(len(points), dtype=torch.long)
    found = []
    for view in torch.randperm(cameras.num_views, generator=torch.Generator().manual_seed(1)):
        pixels, depth = project(points, cameras.cam_from_world[view], cameras.intrinsics[view])
        column, row = pixels.floor().long().unbind(dim=1)
        inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
        same = (maps.inverse_depth[view, row, column] - 1 / depth).abs() < 2 * maps.step[view]
        sees = inside & maps.valid[view, row, column] & same & (count < most)
        count += sees
        (which,) = torch.nonzero(sees, as_tuple=True)
        found.append((which, cameras.centers_world[view].expand(len(which), 3)))
    return torch.cat([one for one, _ in found]), torch.cat([one for _, one in found])


Arcs = tuple[np.ndarray, np.ndarray, np.ndarray]


def _votes(
    mesh: Delaunay,
    points: Float[Tensor, "ray 3"],
    centers: Float[Tensor, "ray 3"],
    sigma: float,
) -> tuple[Arcs, np.ndarray, np.ndarray]:
    """Walk along the rays: facets that they cross are dear, cells before are empty, behind full."""
    towards = centers - points
    length = towards.norm(dim=1, keepdim=True)
    towards = towards / length
    near = torch.linspace(0, _SPAN * sigma, _PLACES // 2).double()
    # Beyond the span the cost of a ray is constant, and only marks space as empty.
    far = torch.logspace(0, 1.5, _PLACES // 2).double() * _SPAN * sigma
    along = torch.cat([near + 1e-3 * sigma, far[1:]])
    places = points[:, None] + along[:, None] * towards[:, None]
    cell = mesh.find_simplex(places.numpy().reshape(-1, 3)).reshape(len(points), -1)
    behind = mesh.find_simplex((points - sigma * towards).numpy())
    weight = 1 - np.exp(-(along.numpy() ** 2) / (2 * sigma**2))
    before, after = cell[:, 1:], cell[:, :-1]  # from the camera inward
    crossed = (before != after) & (before >= 0) & (after >= 0)
    # Where a place between was not looked up, the cells are tied all the same.
    cost = np.broadcast_to(weight[1:], before.shape)
    arcs = before[crossed], after[crossed], cost[crossed]
    source, sink = np.zeros(len(mesh.simplices)), np.zeros(len(mesh.simplices))
    first = np.where(cell[:, ::-1] >= 0, cell[:, ::-1], -1)
    outermost = first[np.arange(len(first)), (first >= 0).argmax(axis=1)]
    np.add.at(source, outermost[outermost >= 0], 1.0)
    np.add.at(sink, behind[behind >= 0], 1.0)
    return arcs, source, sink


def _shapes(corners: Float[Tensor, "cell 4 3"], beside: Int[Tensor, "cell 4"]) -> Arcs:
    """Weight facets by their angles with the circumspheres: thin cells are not surface."""
    edges = corners[:, 1:] - corners[:, :1]
    safe = edges + 1e-12 * torch.eye(3, dtype=edges.dtype)
    offset = torch.linalg.solve(safe, 0.5 * edges.square().sum(dim=2, keepdim=True))[..., 0]
    centre, radius = corners[:, 0] + offset, offset.norm(dim=1)
    cosines = []
    for slot in range(4):
        others = [corner for corner in range(4) if corner != slot]
        a, b, c = corners[:, others].unbind(dim=1)
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
        side = (((corners[:, slot] - a) * normal).sum(dim=1)).sign()
        cosines.append(side * ((centre - a) * normal).sum(dim=1) / radius.clamp_min(1e-12))
    cosine = torch.stack(cosines, dim=1)
    cell, slot = torch.nonzero(beside >= 0, as_tuple=True)
    other = beside[cell, slot]
    back = (beside[other] == cell[:, None]).long().argmax(dim=1)
    price = 1 - torch.minimum(cosine[cell, slot], cosine[other, back])
    return cell.numpy(), other.numpy(), price.clamp(0, 2).nan_to_num(2).numpy()


def _cut(count: int, arcs: Arcs, shapes: Arcs, source: np.ndarray, sink: np.ndarray) -> np.ndarray:
    """Solve, and mark the cells on the sink's side."""
    cells = np.arange(count)
    start = np.concatenate([arcs[0], shapes[0], np.full(count, count), cells])
    end = np.concatenate([arcs[1], shapes[1], cells, np.full(count, count + 1)])
    cost = np.concatenate([arcs[2], shapes[2], source, sink])
    graph = coo_array((cost, (start, end)), shape=(count + 2, count + 2)).tocsr()
    graph.data = np.minimum(np.round(_UNIT * graph.data), 2**30)
    graph = graph.astype(np.int32)
    flow = maximum_flow(graph, count, count + 1, method="dinic")
    left = graph - flow.flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = breadth_first_order(left, count, return_predecessors=False)
    full = np.ones(count + 2, dtype=bool)
    full[reached] = False
    return full[:count]


def _border(
    points: Float[Tensor, "point 3"],
    tetrahedra: Int[Tensor, "cell 4"],
    beside: Int[Tensor, "cell 4"],
    full: Bool[Tensor, " cell"] | np.ndarray,
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Return the facets between full and empty cells, outward."""
    full = torch.as_tensor(full)
    other = torch.where(beside >= 0, full[beside.clamp_min(0)], False)
    cell, slot = torch.nonzero(full[:, None] & ~other, as_tuple=True)
    faces = torch.stack(
        [tetrahedra[cell].gather(1, ((slot + step) % 4)[:, None])[:, 0] for step in (1, 2, 3)],
        dim=1,
    )
    a, b, c = points[faces].unbind(dim=1)
    opposite = points[tetrahedra[cell].gather(1, slot[:, None])[:, 0]]
    inward = ((opposite - a) * torch.linalg.cross(b - a, c - a)).sum(dim=1) > 0
    faces = torch.where(inward[:, None], faces.flip(1), faces)
    used, faces = torch.unique(faces, return_inverse=True)
    return points[used], faces
