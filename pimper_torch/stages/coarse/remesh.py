"""Remeshing: facets that deviate from the surface are split, and those without data dropped."""

from bisect import bisect_right

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.surfaces import face_normals, side_lengths, unit_face_normals
from pimper_torch.geometry.topology import face_edges, vertex_fans
from pimper_torch.linalg.sums import sum_at, total
from pimper_torch.records import CoarseMesh, Mesh, Surface, SweptPatches
from pimper_torch.records.shapes import Edges, FaceMask, Faces, PerFacet, Vertices
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.coarse import splitting
from pimper_torch.stages.coarse.coarse_config import RemeshConfig
from pimper_torch.stages.coarse.trim import enclosed_holes
from pimper_torch.stages.stage import Stage

# Barycentric coordinate of a vertex on an edge, at most: edges have far fewer than a million parts.
_ON_EDGE = 1e-6

# The corners of a facet do not move if its area would shrink below this fraction, or its longest
# side grow by this factor: the facet collapses, or a corner is an outlier. Choices.
_MIN_AREA, _MAX_STRETCH = 0.05, 4.0


class Remesh(Stage):
    """Fit the coarse mesh to a surface; see :func:`remesh`."""

    kept_as = CoarseMesh

    def __init__(self, config: RemeshConfig | None = None) -> None:
        super().__init__()
        self.config = config or RemeshConfig()

    def forward(self, swept: SweptPatches, surface: Surface, contours: Contours) -> CoarseMesh:
        """Return the patches' coarse mesh fitted to the surface that was reconstructed on it.

        Lengths are in sample spacings of these patches. Inside a visual hull all facets stay: the
        coarse mesh is already trimmed. Without one, facets in two views have data, lit or not.
        """
        patches = swept.patches
        residual = surface.information.new_full((patches.num_patches,), torch.nan)
        seen = torch.full_like(residual, contours.confine, dtype=torch.bool)
        for templates, solution, heights in zip(
            patches.buckets, swept.photometric.buckets, swept.buckets, strict=True
        ):
            values = torch.where(solution.determined, solution.convergence.residual, torch.nan)
            residual[templates.facet] = values.detach().to(residual)
            seen[templates.facet] |= heights.num_views >= 2
        return remesh(
            patches.coarse,
            surface,
            float(patches.buckets[0].spacing[0].detach()),
            self.config,
            residual=residual,
            seen=seen,
        )


def remesh(
    coarse: CoarseMesh,
    surface: Surface,
    spacing: float,
    config: RemeshConfig | None = None,
    *,
    residual: PerFacet | None = None,
    seen: Bool[Tensor, " facet"] | None = None,
) -> CoarseMesh:
    """Fit the coarse mesh to the surface that was reconstructed on it.

    Every facet is split into at most four, neighbours are cut so that the mesh stays conforming
    (see :mod:`~pimper_torch.stages.coarse.splitting`), and all vertices, old and new, move onto the
    surface. If this would fold, flatten or stretch a facet, its vertices stay on the old mesh.

    Args:
        coarse: Facets that ``surface`` subdivides.
        surface: Subdivided mesh; facets share its vertices on their common edges.
        spacing: Sample spacing of the next templates, scene units: the unit of the settings.
        residual: Photometric residual of each facet, in any unit; NaN for none.
        seen: True for facets that have data even if the surface has no support there.

    Returns:
        The new mesh. Its normals are the piecewise linear fit to the surface's. Unused vertices are
        dropped, and parts of the mesh that are joined only at a vertex get a copy of it each.

    If the surface has no support at all, no facet is dropped. Differentiable: vertices and normals,
    in those of the surface and the old mesh; which facets are split, dropped or moved is constant.
    """
    config = config or RemeshConfig()
    old, faces = coarse.mesh.vertices_world, coarse.mesh.faces
    count = int(surface.facet.max()) + 1 if len(surface.facet) else 0
    if count == 0 or count > len(faces):
        raise InputError(
            f"remesh: the surface is on {count} facets, but the coarse mesh has {len(faces)}; "
            "needed: the surface reconstructed on this mesh. Give both from the same pass."
        )
    edges, face_edge = face_edges(faces)
    corners, centres = _on_surface(old, faces, edges, face_edge, surface)
    with torch.no_grad():
        kept = _with_data(old, faces, surface, seen, config.max_hole)
        leave_out("remesh.data", ~kept, at=(old, faces))
        severity = _severities(corners, faces, surface, residual, spacing, config)
        # Side of the equilateral triangle of each facet's area.
        side = (2 / 3**0.5 * face_normals(corners, faces).norm(dim=1)).sqrt() / spacing
        small = (side < config.min_samples) | ~kept
        marked = _worst_first(old, faces, severity, small, kept, config.max_facets)
        split = splitting.split_edges(old, faces, marked)
    flat = torch.cat([old, old[edges[split.halved]].mean(dim=1)])
    onto = torch.cat([corners, centres[split.halved]])
    child_kept = kept[split.parent]
    positions = _without_folds(flat, onto, split.faces[child_kept])
    source, new_faces = vertex_fans(split.faces[child_kept])
    index = torch.full_like(split.parent, -1)
    index[child_kept] = torch.arange(int(child_kept.sum()), device=faces.device)
    mesh = Mesh(vertices_world=positions[source], faces=new_faces)
    mesh = mesh.replace(normals_world=splitting.fitted_normals(mesh, surface, split, index))
    return splitting.with_relocated_points(coarse, mesh, split, index)


def _on_surface(
    vertices: Vertices, faces: Faces, edges: Edges, face_edge: Faces, surface: Surface
) -> tuple[Vertices, Float[Tensor, "edge 3"]]:
    """Return positions on the surface of the vertices and, interpolated, the edges' midpoints."""
    zeros = surface.barycentric < _ON_EDGE
    count = zeros.sum(dim=1)
    (at_corner,) = torch.nonzero(count == 2, as_tuple=True)
    corner = surface.barycentric[at_corner].argmax(dim=1, keepdim=True)
    vertex = faces[surface.facet[at_corner]].gather(1, corner)[:, 0]
    moved = vertices.clone()
    moved[vertex] = surface.vertices_world[at_corner].to(moved)

    (on_edge,) = torch.nonzero(count == 1, as_tuple=True)
    facet, opposite = surface.facet[on_edge], zeros[on_edge].long().argmax(dim=1, keepdim=True)
    edge = face_edge[facet].gather(1, opposite)[:, 0]
    far_slot = (faces[facet] == edges[edge, 1, None]).long().argmax(dim=1, keepdim=True)
    along = surface.barycentric[on_edge].gather(1, far_slot)[:, 0]
    below, above = along <= 0.5, along >= 0.5
    low = along.new_zeros(len(edges)).scatter_reduce(0, edge[below], along[below], "amax")
    high = along.new_ones(len(edges)).scatter_reduce(0, edge[above], along[above], "amin")
    start, end = moved[edges[:, 0]], moved[edges[:, 1]]
    cut = surface.vertices_world[on_edge].to(moved)
    first, last = below & (along == low[edge]), above & (along == high[edge])
    start[edge[first]], end[edge[last]] = cut[first], cut[last]
    gap = high - low
    fraction = torch.where(gap > 0, (0.5 - low) / torch.where(gap > 0, gap, 1), 0)[:, None]
    return moved, (1 - fraction) * start + fraction * end


def _with_data(
    vertices: Vertices, faces: Faces, surface: Surface, seen: FaceMask | None, max_hole: float
) -> FaceMask:
    """Return the facets with data or enclosed by such; all if none has data."""
    supported = surface.supported
    inner = (surface.barycentric >= _ON_EDGE).all(dim=1)
    if not bool(supported.any()):
        return torch.ones_like(faces[:, 0], dtype=torch.bool)
    inside = torch.bincount(surface.facet[inner], minlength=len(faces))
    data = torch.bincount(surface.facet[inner & supported], minlength=len(faces)) > 0
    # A facet too small to have vertices inside has data if all its corners have.
    at_corner = (surface.barycentric > 1 - _ON_EDGE).any(dim=1) & supported
    slot = surface.barycentric[at_corner].argmax(dim=1, keepdim=True)
    at_vertex = torch.zeros(len(vertices), dtype=torch.bool, device=faces.device)
    at_vertex[faces[surface.facet[at_corner]].gather(1, slot)[:, 0]] = True
    data = torch.where(inside > 0, data, at_vertex[faces].all(dim=1))
    if seen is not None:
        data = data | seen
    if not bool(data.any()):
        return ~data
    area = face_normals(vertices, faces).norm(dim=1) / 2
    return data | enclosed_holes(vertices, faces, data, max_hole * float(total(area)))


def _severities(
    vertices: Vertices,
    faces: Faces,
    surface: Surface,
    residual: PerFacet | None,
    spacing: float,
    config: RemeshConfig,
) -> Float[Tensor, " face"]:
    """Return how much facets deviate from the surface; those above 1 are split."""
    severity = plane_deviations(vertices, faces, surface) / (config.max_departure * spacing)
    spread = torch.rad2deg(normal_spreads(len(faces), surface)) / config.max_spread_deg
    severity = torch.maximum(severity, spread.to(severity))
    if residual is None:
        return severity
    typical = residual.nanmedian()
    relative = residual / torch.where(typical > 0, typical, torch.inf) / 3.0
    return torch.maximum(severity, relative.nan_to_num(nan=0.0).to(severity))


def plane_deviations(vertices: Vertices, faces: Faces, surface: Surface) -> Float[Tensor, " face"]:
    """Return the 90th percentile of the surface's distances to each facet's plane."""
    normals = unit_face_normals(vertices, faces)
    centre = vertices[faces].mean(dim=1)
    offset = surface.vertices_world.to(vertices) - centre[surface.facet]
    distance = (offset * normals[surface.facet]).sum(dim=1).abs()
    order = distance.argsort()
    order = order[surface.facet[order].argsort(stable=True)]
    count = torch.bincount(surface.facet, minlength=len(faces))
    rank = (0.9 * (count - 1).clamp_min(0)).ceil().long()
    last = (count.cumsum(dim=0) - count + rank).clamp_max(len(order) - 1)
    return torch.where(count > 0, distance[order[last]], 0)


def normal_spreads(count: int, surface: Surface) -> Float[Tensor, " {count}"]:
    """Return the root mean square angle between the surface's normals and their facet's mean."""
    weight = splitting.normal_weights(surface.information)
    summed = sum_at(surface.facet, weight[:, None] * surface.normals_world, count)
    mass = sum_at(surface.facet, weight, count)
    length = summed.norm(dim=1) / torch.where(mass > 0, mass, 1)
    # For small angles a to the mean, 1 - cos(a) is a^2 / 2.
    return torch.where(mass > 0, (2 * (1 - length)).clamp_min(0).sqrt(), 0)


def _worst_first(
    vertices: Vertices,
    faces: Faces,
    severity: Float[Tensor, " face"],
    small: FaceMask,
    kept: FaceMask,
    max_facets: int,
) -> Bool[Tensor, " edge"]:
    """Return the edges to halve for as many of the worst facets as the limit allows."""
    _, face_edge = face_edges(faces)
    wanted = torch.where(small, 0, severity)
    order = wanted.argsort(descending=True, stable=True)
    most = int((wanted > 1).sum())

    def marks(count: int) -> Bool[Tensor, " edge"]:
        chosen = torch.zeros_like(small)
        chosen[order[:count]] = True
        return splitting.mark_edges(vertices, faces, chosen, small)

    def facets(count: int) -> int:
        return int((1 + marks(count)[face_edge].sum(dim=1))[kept].sum())

    if facets(most) > max_facets:
        most = bisect_right(range(1, most), max_facets, key=facets)
    return marks(most)


def _without_folds(flat: Vertices, onto: Vertices, faces: Faces) -> Vertices:
    """Return vertices moved onto the surface unless this folds, flattens or stretches facets."""
    before = face_normals(flat, faces)
    size = before.square().sum(dim=1)
    longest = _MAX_STRETCH * side_lengths(flat[faces]).amax(dim=1)
    moving = onto.isfinite().all(dim=1)
    while True:
        moved = torch.where(moving[:, None], onto, flat)
        along = (face_normals(moved, faces) * before).sum(dim=1)
        bad = (along <= _MIN_AREA * size) | (side_lengths(moved[faces]).amax(dim=1) > longest)
        bad &= moving[faces].any(dim=1)
        if not bool(bad.any()):
            return moved
        moving[faces[bad].flatten()] = False
