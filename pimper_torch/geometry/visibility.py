"""Visibility by ray casting on triangle meshes.

The only module that calls embree, which runs on the CPU in float32 whatever the device of the
tensors. The face that a ray hits is a constant to autograd; the hit point on that face is
differentiable by :meth:`Hits.refined`.
"""

from dataclasses import dataclass
from threading import Lock

import numpy as np
import torch
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils.weak import WeakTensorKeyDictionary

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.records import Cameras, Mesh, Record, Surface
from pimper_torch.records.shapes import Faces, Scalars, Vectors, Vertices
from pimper_torch.runtime.memory import emptied_on_release

Places = Float[Tensor, "*#batch 3"]
Lengths = Float[Tensor, "*#batch"]
Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Hits(Record):
    """First intersections of rays with a mesh.

    Attributes:
        face: Index of the face; -1 for a miss.
        distance: Along the ray in units of its direction's length; infinite for a miss.
        barycentric: Coordinates of the hit point in its face; zero for a miss.
    """

    face: Int[Tensor, "*batch"]
    distance: Scalars
    barycentric: Vectors

    def interpolate(
        self, per_vertex: Float[Tensor, "vertex channel"], faces: Faces
    ) -> Float[Tensor, "*batch channel"]:
        """Interpolate vertex values at the hit points; zero for a miss."""
        corners = per_vertex[faces[self.face.clamp_min(0)]]
        values = (self.barycentric[..., None] * corners).sum(dim=-2)
        return torch.where((self.face >= 0)[..., None], values, 0)

    def where(self, chosen: Bool[Tensor, "*batch"], other: "Hits") -> "Hits":
        """Return the chosen hits, and those of other rays elsewhere."""
        return Hits(
            face=torch.where(chosen, self.face, other.face),
            distance=torch.where(chosen, self.distance, other.distance),
            barycentric=torch.where(chosen[..., None], self.barycentric, other.barycentric),
        )

    def refined(
        self, vertices: Vertices, faces: Faces, origins: Places, directions: Vectors
    ) -> "Hits":
        """Recompute the intersections with the same faces, in the dtype of the rays.

        Differentiable in vertices, origins and directions. Rays in a face's plane are not changed.
        """
        hit = self.face >= 0
        a, b, c = vertices[faces[self.face.clamp_min(0)]].unbind(dim=-2)
        ab, ac = b - a, c - a
        normal = torch.linalg.cross(ab, ac)
        rate = (directions * normal).sum(dim=-1)
        sound = hit & (rate != 0)
        distance = ((a - origins) * normal).sum(dim=-1) / torch.where(sound, rate, 1)
        along = origins + distance[..., None] * directions - a
        area = torch.where(sound, normal.square().sum(dim=-1), 1)
        v = (torch.linalg.cross(along, ac) * normal).sum(dim=-1) / area
        w = (torch.linalg.cross(ab, along) * normal).sum(dim=-1) / area
        barycentric = torch.stack([1 - v - w, v, w], dim=-1)
        return self.replace(
            distance=torch.where(sound, distance, self.distance),
            barycentric=torch.where(sound[..., None], barycentric, self.barycentric),
        )


class RayCaster:
    """A mesh prepared for ray casting.

    >>> square = torch.tensor([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    >>> caster = RayCaster(square, torch.tensor([[0, 2, 1], [0, 3, 2]]))
    >>> hits = caster.cast(torch.zeros(1, 3), torch.tensor([[0.2, 0.1, 1.0]]))
    >>> hits.distance.round(decimals=4)
    tensor([1.])
    """

    def __init__(self, vertices: Vertices, faces: Faces) -> None:
        self._origin: Float[Tensor, "3"] | None = None
        if len(vertices):
            low, high = vertices.detach().amin(dim=0), vertices.detach().amax(dim=0)
            middle = (low + high) / 2
            # Rounding to single precision moves a mesh this far away by over 1e-6 of its diagonal.
            if bool(middle.norm() > 16.0 * (high - low).norm()):
                self._origin = middle
        points = self._near(vertices.detach()).to("cpu", torch.float32)
        corners = faces.to("cpu", torch.int32)
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, points.numpy(), corners.numpy())
        # The first ray builds the tree, which is not thread-safe.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def cast(self, origins: Places, directions: Vectors, reach: Lengths | None = None) -> Hits:
        """Return the first intersection of each ray.

        Args:
            reach: Maximum distance of each, in lengths of its direction; infinite by default.
        """
        shape = directions.shape[:-1]
        far = None if reach is None else _reaches(reach, shape)
        result = self._scene.run(*self._rays(origins, directions), dists=far, output=1)
        face = torch.from_numpy(result["primID"].astype(np.int64))
        hit = face >= 0
        distance = torch.where(hit, torch.from_numpy(result["tfar"]), torch.inf)
        v, w = torch.from_numpy(result["u"]), torch.from_numpy(result["v"])
        barycentric = torch.stack([1 - v - w, v, w], dim=-1) * hit[:, None]
        return Hits(
            face=face.reshape(shape).to(directions.device),
            distance=distance.reshape(shape).to(directions),
            barycentric=barycentric.reshape(*shape, 3).to(directions),
        )

    def _near(self, points: Vectors) -> Vectors:
        return points if self._origin is None else points - self._origin.to(points)

    def _rays(self, origins: Places, directions: Vectors) -> tuple[Rows, ...]:
        rays = self._near(origins).expand_as(directions), directions
        rows = (part.detach().to("cpu", torch.float32).reshape(-1, 3).numpy() for part in rays)
        return tuple(map(np.ascontiguousarray, rows))

    def occluded(
        self, points: Vectors, center: Float[Tensor, " 3"], tolerance: float | Lengths
    ) -> Bool[Tensor, "*batch"]:
        """Return whether the mesh occludes points from a camera.

        Args:
            tolerance: Distance in front of the point, scene units, within which surface is ignored:
                it is the surface that the point is on.
        """
        directions = points - center
        length = directions.norm(dim=-1)
        hits = self.cast(center, directions / length[..., None])
        return hits.distance < length - tolerance

    def blocked(
        self, origins: Places, directions: Vectors, reach: Lengths
    ) -> Bool[Tensor, "*batch"]:
        """Return whether each ray hits any face; several times as fast as :meth:`cast`.

        Args:
            reach: Maximum distance of each, in lengths of its direction; may be infinite.
        """
        shape = directions.shape[:-1]
        rays = self._rays(origins, directions)
        faces = self._scene.run(*rays, dists=_reaches(reach, shape), query="OCCLUDED")
        return (torch.from_numpy(faces) >= 0).reshape(shape).to(directions.device)


# Faces and caster of each mesh, while its vertices exist. The last surface's takes some 200 MB.
_prepared: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
emptied_on_release(_prepared.clear)
_preparing = Lock()


def ray_caster(mesh: Mesh | Surface) -> RayCaster:
    """Return the caster of a mesh, cached until memory is released or its vertices' end."""
    with _preparing:
        faces, caster = _prepared.get(mesh.vertices_world, (None, None))  # type: ignore[no-untyped-call]
        if faces is not mesh.faces:
            caster = RayCaster(mesh.vertices_world, mesh.faces)
            _prepared[mesh.vertices_world] = mesh.faces, caster
        return caster


def cast_view(mesh: Mesh | RayCaster, cameras: Cameras, view: int) -> Hits:
    """Cast a ray through every pixel of a view; the caster of a mesh is cached.

    Returns:
        Hits of shape ``height width``; ``distance`` is depth along the camera's z.
    """
    width, height = (int(side) for side in cameras.sizes_px[view])
    pixels = pixel_centers(width, height, like=cameras.intrinsics)
    pose, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    rays = rays_through(pixels.reshape(-1, 2), pose, intrinsics).reshape(height, width, 3)
    caster = ray_caster(mesh) if isinstance(mesh, Mesh) else mesh
    return caster.cast(cameras.centers_world[view], rays)


# Distance of occluding surface from a vertex, over the mesh's diagonal, that is not its own.
_OWN = 0.005


@torch.no_grad()
def visible_vertices(
    mesh: Mesh, cameras: Cameras, min_cosine: float = 0.0
) -> Bool[Tensor, "view vertex"]:
    """Return which vertices each camera sees: in its image, facing it and not occluded.

    A discrete choice, for example constant over the steps of a training loop.

    Args:
        min_cosine: Least cosine between the normal and the direction to the camera.
    """
    points, caster = mesh.vertices_world, ray_caster(mesh)
    normals = normalize(carried_normals(mesh), dim=-1)
    size = (points.amax(dim=0) - points.amin(dim=0)).norm()
    rows = []
    for view, center in enumerate(cameras.centers_world.to(points)):
        camera = cameras.cam_from_world[view], cameras.intrinsics[view]
        pixels, depth = project(points, *(matrix.to(points) for matrix in camera))
        seen = (normalize(center - points, dim=1) * normals).sum(dim=1) > min_cosine
        seen &= ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
        rows.append(seen & ~caster.occluded(points, center, float(_OWN * size)))
    return torch.stack(rows)


def _reaches(reach: Lengths, shape: torch.Size) -> Rows:
    far = reach.detach().expand(shape).reshape(-1).to("cpu", torch.float32)
    # embree's infinity
    return far.clamp(0, 1e37).contiguous().numpy()
