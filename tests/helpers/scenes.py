"""Parts of scenes shared by tests of several subpackages."""

from pathlib import Path

import torch

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.geometry.topology import half_edges
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Mesh, Silhouettes, SparseScene

# A square of side 1 and its two facets.
CORNERS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
FACETS = torch.tensor([[0, 1, 2], [0, 2, 3]])


def subdivided_square(spacing):
    """Subdivide the square."""
    return subdivide(CORNERS, FACETS, torch.full((2,), spacing, dtype=torch.float64))


def tilted_square(x=0.0, y=0.0):
    """Return a square of side 2 about the origin, float32, with slopes ``x`` and ``y`` of z."""
    vertices = 2 * CORNERS - torch.tensor([1.0, 1, 0])
    vertices[:, 2] = vertices[:, :2] @ torch.tensor([x, y], dtype=torch.float64)
    return Mesh(vertices_world=vertices.float(), faces=FACETS)


def from_above(focal_px, width, height):
    """Return a camera at z = 5 that looks at the origin, y up."""
    pose = look_at(torch.tensor([[0.0, 0, 5]]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    return pinholes(pose, focal_px, width, height)


def ball(radius=1.0, level=3, center=(0.0, 0.0, 0.0)):
    """Return a ball of ``20 * 4**level`` faces; one radius per axis gives an ellipsoid."""
    vertices, faces = icosphere(level)
    placed = vertices * vertices.new_tensor(radius) + vertices.new_tensor(center)
    return Mesh(vertices_world=placed, faces=faces)


def trusted(inside, source="masks", **more):
    """Return silhouettes that are reliable in every view."""
    reliable = torch.ones(len(inside), dtype=torch.bool)
    return Silhouettes(inside=inside, reliable=reliable, source=source, **more)


def write_ball(path: Path, *shape, **options) -> Path:
    """Write a ball as PLY."""
    write_ply(ball(*shape, **options), path)
    return path


def observed(views, cameras, points, pixels, seen, lens):
    """Return a scene of points without noise, observed in the views that see them."""
    view, point = seen.nonzero(as_tuple=True)
    return SparseScene(
        views=views,
        cameras=cameras,
        points_world=points,
        reprojection_errors_px=torch.zeros(len(points)),
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, point],
        lenses=(lens,) * len(pixels),
    )


def observing(scene, kept):
    """Select observations of a scene."""
    return scene.replace(
        observation_point=scene.observation_point[kept],
        observation_view=scene.observation_view[kept],
        observation_pixels=scene.observation_pixels[kept],
    )


def without_points(scene):
    """Remove the cloud."""
    return observing(scene, slice(0)).replace(
        points_world=scene.points_world[:0], reprojection_errors_px=scene.reprojection_errors_px[:0]
    )


def edge_counts(faces):
    """Return edges with their number of faces."""
    return torch.unique(half_edges(faces).sort(dim=1).values, dim=0, return_counts=True)


def each_bucket(record, change):
    """Change every bucket of patches."""
    return record.replace(buckets=tuple(map(change, record.buckets)))


def first_bucket(record, **changes):
    """Replace fields of the first bucket of patches."""
    first, *others = record.buckets
    return record.replace(buckets=(first.replace(**changes), *others))
