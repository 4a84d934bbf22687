"""Results of structure from motion, and triangle meshes."""

from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.shapes import Faces, PerVertex, Points, VertexMask, Vertices
from pimper_torch.records.value_checks import Faults, faults_in, mean, not_finite, out_of_range
from pimper_torch.records.views import Cameras, Views
from pimper_torch.runtime.later import later

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CameraModel(Record):
    """Intrinsics of one photograph before undistortion, in COLMAP's terms.

    Attributes:
        camera: Number of the camera; views taken by one camera share it.
        model: COLMAP's name of the camera model, such as ``SIMPLE_RADIAL``.
        params: The model's parameters in COLMAP's order.
        width: In pixels, like ``height``.
    """

    camera: int
    model: str
    params: tuple[float, ...]
    width: int
    height: int


# Empty defaults, on the CPU whatever torch's default device is.
no_maps = partial(torch.zeros, 0, 3, 3, dtype=torch.float32, device="cpu")
no_sessions = partial(torch.zeros, 0, dtype=torch.long, device="cpu")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SparseScene(Record):
    """Cameras, undistorted photographs and a sparse cloud with its tracks.

    Attributes:
        views: The registered photographs, undistorted to the pinholes in ``cameras``.
        cameras: Pinholes, one per registered view.
        reprojection_errors_px: Mean over each point's track.
        observation_point: Index of the observed point.
        observation_view: Index of the observing view.
        observation_pixels: Position in the photograph before undistortion.
        lenses: Intrinsics of the photographs before undistortion.
        unregistered: Names of the photographs that were not registered.
        given: Whether cameras were given: those of some photographs may be missing on purpose.
        diagnosis: Why the cameras may be wrong, and what to do; empty without such evidence.
        background_from_view: Homographies from pixels of each undistorted photograph to pixels of
            the static background of a turntable; NaN where a view contains too little of it. Empty
            without such a background.
        offset_world: Added to this scene's coordinates, it gives those of the model that was read.
            Scenes far from that model's origin have a local one, see
            :func:`~pimper_torch.geometry.local_frame.local_origin`.
        sessions: Number of each view's capture session if the object was moved relative to its
            surroundings between sessions. Empty otherwise.
    """

    views: Views
    cameras: Cameras
    points_world: Points
    reprojection_errors_px: Float[Tensor, " point"]
    observation_point: Int[Tensor, " observation"]
    observation_view: Int[Tensor, " observation"]
    observation_pixels: Float[Tensor, "observation 2"]
    lenses: tuple[CameraModel, ...]
    unregistered: tuple[str, ...] = ()
    given: bool = False
    diagnosis: str = ""
    background_from_view: Float[Tensor, "mapped 3 3"] = field(default_factory=no_maps)
    offset_world: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sessions: Int[Tensor, " divided"] = field(default_factory=no_sessions)

    def faults(self) -> Faults:
        """List inconsistent numbers and indices, and cameras that look away from the cloud."""
        yield from super(SparseScene, self).faults()
        count, views = len(self.points_world), self.cameras.num_views
        if self.views.num_views != views:
            yield "cameras", f"has {views} entries", f"one for each of {self.views.num_views} views"
        yield from faults_in("points_world", "finite points", not_finite, self.points_world)
        for what, of in (("point", count), ("view", views)):
            name, needed = f"observation_{what}", f"indices of {of} {what}s"
            yield from faults_in(name, needed, out_of_range, getattr(self, name), of)
        for name in ("background_from_view", "sessions"):
            if (length := len(getattr(self, name))) not in (0, views):
                yield name, f"has {length} entries", f"none, or one for each of {views} views"
        if count:
            pose, points = self.cameras.cam_from_world.detach(), self.points_world.detach()
            depth = pose[:, 2, :3] @ points.mT + pose[:, 2, 3:]
            behind = float((depth <= 0).float().mean())
            if behind > 0.5:
                yield (
                    "cameras.cam_from_world",
                    f"look away from the cloud: {behind:.0%} of its points are behind them",
                    "axes x right, y down, z forward; for the axes of OpenGL and Blender (y up, z "
                    "back), negate the second and third row",
                )

    @property
    def observed(self) -> Bool[Tensor, "point view"]:
        """True where a view observes a point."""
        shape = len(self.points_world), self.cameras.num_views
        return pairs_table(self.observation_point, self.observation_view, shape)

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {
            "views": self.views.num_views + len(self.unregistered),
            "registered": self.views.num_views,
            "sparse_points": len(self.points_world),
            "mean_track_length": len(self.observation_point) / max(1, len(self.points_world)),
            "mean_reprojection_px": mean(self.reprojection_errors_px),
            "doubtful": int(bool(self.diagnosis)),
        }


def pairs_table(
    point: Int[Tensor, " observation"], view: Int[Tensor, " observation"], shape: tuple[int, int]
) -> Bool[Tensor, "point view"]:
    """Return a table that is true for the observed pairs of point and view."""
    table = torch.zeros(shape, dtype=torch.bool, device=point.device)
    table[point, view] = True
    return table


def with_views(scene: SparseScene, kept: Bool[Tensor, " view"]) -> SparseScene:
    """Keep some views and their observations; the others count as unregistered."""
    index = kept.nonzero()[:, 0].tolist()
    observed = kept.to(scene.observation_view.device)[scene.observation_view]
    number = kept.long().cumsum(dim=0).to(scene.observation_view.device) - 1
    maps, sessions, names = scene.background_from_view, scene.sessions, scene.views.names
    left_out = tuple(name for name, keep in zip(names, kept.tolist(), strict=True) if not keep)
    return scene.replace(
        views=scene.views.take(index),
        cameras=scene.cameras.take(index),
        observation_point=scene.observation_point[observed],
        observation_view=number[scene.observation_view[observed]],
        observation_pixels=scene.observation_pixels[observed],
        lenses=tuple(scene.lenses[view] for view in index) if scene.lenses else (),
        unregistered=(*scene.unregistered, *left_out),
        background_from_view=maps[kept.to(maps.device)] if len(maps) else maps,
        sessions=sessions[kept.to(sessions.device)] if len(sessions) else sessions,
    )


def with_points(scene: SparseScene, kept: Bool[Tensor, " point"]) -> SparseScene:
    """Keep some points and their observations."""
    observed = kept[scene.observation_point]
    number = kept.long().cumsum(dim=0) - 1
    return scene.replace(
        points_world=scene.points_world[kept],
        reprojection_errors_px=scene.reprojection_errors_px[kept],
        observation_point=number[scene.observation_point[observed]],
        observation_view=scene.observation_view[observed],
        observation_pixels=scene.observation_pixels[observed],
    )


class ViewPerPose(NamedTuple):
    """A scene with one photograph of every pose.

    Attributes:
        scene: One photograph per pose, with the observations of all photographs of the pose.
        chosen: Indices of these photographs in the complete scene.
        of: For each view of the complete scene, the index in ``scene`` of the view with its pose.
    """

    scene: SparseScene
    chosen: Int[Tensor, " pose"]
    of: Int[Tensor, " view"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Mesh(Record):
    """Triangle mesh; faces are counter-clockwise seen from outside.

    Attributes:
        normals_world: Unit, outward, one per vertex.
        albedo: Linear, one per vertex, up to one scale for the mesh.
        confidence: In [0, 1], one per vertex: how well the photographs determine it.
        expected_error: Standard error of each vertex along the normal, scene units, with the
            cameras taken as exact.
    """

    vertices_world: Vertices
    faces: Faces
    normals_world: Vertices | None = None
    albedo: Float[Tensor, "vertex channel"] | None = None
    confidence: PerVertex | None = None
    expected_error: PerVertex | None = None

    def faults(self) -> Faults:
        """List faces with invalid vertex indices, and vertices that are not finite."""
        count = len(self.vertices_world)
        yield from faults_in(
            "faces", f"indices of {count} vertices", out_of_range, self.faces, count
        )
        yield from faults_in("vertices_world", "finite vertices", not_finite, self.vertices_world)

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {"vertices": len(self.vertices_world), "faces": len(self.faces)}

    def save(self, path: Path | str) -> None:
        """Write it as PLY, GLB, OBJ or STL; see :func:`~pimper_torch.io.meshes.write_mesh`."""
        later("io.meshes.write_mesh")(self, path)

    def to_trimesh(self) -> "Trimesh":
        """Return it as a mesh of trimesh; see :func:`~pimper_torch.io.meshes.trimesh_of`."""
        mesh: Trimesh = later("io.meshes.trimesh_of")(self)
        return mesh


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FacetPoints(Record):
    """Points of the sparse cloud on facets, other than their vertices.

    Attributes:
        points_world: Triangulated positions.
        covariance_world: Of each position, scene units squared.
        facet: The facet that each point is on, as seen from the reference view.
    """

    points_world: Points
    covariance_world: Float[Tensor, "point 3 3"]
    facet: Int[Tensor, " point"]


class Support(IntEnum):
    """The best evidence of a facet's position."""

    NOTHING = 0
    """None; it closes the surface."""
    LIGHT = 1
    """Views contain it lit, so shading determines its shape."""
    CONTOUR = 2
    """Rays through the outlines touch it."""
    POINTS = 3
    """Points matched between views are on it."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CoarseMesh(Record):
    """The coarse surface, up to a few thousand facets, on which patches are defined.

    Attributes:
        mesh: The facets, with vertex normals smoothed over the mesh.
        reference: The frontal view, in which the facets were triangulated.
        is_point: True for vertices that are points of the sparse cloud.
        covariance_world: Of each vertex, scene units squared; ``None`` unless all are points.
        points: The cloud between the vertices; ``None`` for a given mesh.
        support: The best evidence of each facet's position, a value of :class:`Support`; ``None``
            if unknown.
    """

    mesh: Mesh
    reference: int
    is_point: VertexMask
    covariance_world: Float[Tensor, "vertex 3 3"] | None = None
    points: FacetPoints | None = None
    support: Int[Tensor, " face"] | None = None

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {
            "mesh_points": len(self.mesh.vertices_world),
            "filled_points": int((~self.is_point).sum()),
            "triangles": len(self.mesh.faces),
        }
