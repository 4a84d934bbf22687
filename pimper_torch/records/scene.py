"""Results of structure from motion, and triangle meshes."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.ground.shapes import Faces, PerVertex, Points, VertexMask, Vertices
from pimper_torch.records.record import Record
from pimper_torch.records.value_checks import Faults, beyond, faults_in, not_finite
from pimper_torch.records.views import Cameras, Views
from pimper_torch.runtime.renamed import renamed_fields


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CameraModel(Record):
    """Intrinsics of one photograph before undistortion, in COLMAP's words.

    Attributes:
        camera: Number of the camera; views taken by one camera share it.
        model: COLMAP's name of the camera model, such as ``SIMPLE_RADIAL``.
        params: The model's parameters in COLMAP's order.
        width: Pixels, as is the height.
    """

    camera: int
    model: str
    params: tuple[float, ...]
    width: int
    height: int


def no_maps() -> Float[Tensor, "0 3 3"]:
    """Return no maps."""
    return torch.zeros(0, 3, 3)


def no_sessions() -> Int[Tensor, "0"]:
    """Return no numbers of series."""
    return torch.zeros(0, dtype=torch.long)


@renamed_fields(doubt="diagnosis", series="sessions")
@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SparseScene(Record):
    """Cameras, undistorted photographs and a sparse cloud with its tracks.

    Attributes:
        views: The registered photographs, undistorted to the pinholes in ``cameras``.
        cameras: Pinholes, one a registered view.
        reprojection_errors_px: Mean over each point's track.
        observation_point: Which point each observation sees.
        observation_view: Which view it is made in.
        observation_pixels: Where, in the photograph before undistortion.
        lenses: The photographs' own intrinsics.
        unregistered: Names of the photographs that found no place in the model.
        doubt: Why the cameras may be wrong, and what to do; empty where nothing speaks against
            them.
        background_from_view: Maps from homogeneous pixels of each undistorted photograph to those
            where the background is at rest before which the object turns; NaN where a view shows
            too little of it. Empty without such a background.
        offset_world: Added to this scene's coordinates, gives those of the model it was read from.
            Scenes far from that model's origin have one of their own, see
            :func:`~pimper_torch.ground.geometry.local_frame.local_origin`.
        series: Number of each view's series, where the object was moved on what it stands on
            between several: in each its surroundings are elsewhere. Empty where it was not.
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
    diagnosis: str = ""
    background_from_view: Float[Tensor, "mapped 3 3"] = field(default_factory=no_maps)
    offset_world: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sessions: Int[Tensor, " divided"] = field(default_factory=no_sessions)

    def faults(self) -> Faults:
        """List what does not belong together."""
        yield from super(SparseScene, self).faults()
        count, views = len(self.points_world), self.cameras.num_views
        if self.views.num_views != views:
            yield "cameras", f"are {views}", f"one for each of {self.views.num_views} views"
        yield from faults_in("points_world", "finite points", not_finite, self.points_world)
        for what, of in (("point", count), ("view", views)):
            name, needed = f"observation_{what}", f"indices of {of} {what}s"
            yield from faults_in(name, needed, beyond, getattr(self, name), of)
        for name in ("background_from_view", "sessions"):
            if len(found := getattr(self, name)) not in (0, views):
                yield name, f"are {len(found)}", f"none, or one for each of {views} views"
        if count:
            pose, points = self.cameras.cam_from_world.detach(), self.points_world.detach()
            depth = pose[:, 2, :3] @ points.mT + pose[:, 2, 3:]
            behind = float((depth <= 0).float().mean())
            if behind > 0.5:
                yield (
                    "cameras.cam_from_world",
                    f"look away from the cloud: {behind:.0%} of its points are behind them",
                    "axes x right, y down, z forward; those of OpenGL and Blender have y up and z "
                    "back: negate the second and third row",
                )

    @property
    def observed(self) -> Bool[Tensor, "point view"]:
        """True where a view sees a point."""
        shape = len(self.points_world), self.cameras.num_views
        return pairs_table(self.observation_point, self.observation_view, shape)


def pairs_table(
    point: Int[Tensor, " observation"], view: Int[Tensor, " observation"], shape: tuple[int, int]
) -> Bool[Tensor, "point view"]:
    """Find the pairs of point and view that are observations."""
    table = torch.zeros(shape, dtype=torch.bool, device=point.device)
    table[point, view] = True
    return table


def with_views(scene: SparseScene, kept: Bool[Tensor, " view"]) -> SparseScene:
    """Keep some of the views, and what these observe; the others count as not registered."""
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
    """Keep some of the points, and where they were observed."""
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
        scene: Those photographs alone, with what all of their poses observe.
        of: Which of them has the pose of each view of the whole scene.
    """

    scene: SparseScene
    chosen: Int[Tensor, " pose"]
    of: Int[Tensor, " view"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Mesh(Record):
    """Triangles; counter-clockwise seen from outside.

    Attributes:
        normals_world: Unit, outward, one a vertex.
        albedo: Linear, one a vertex, up to one scale for the whole mesh.
        confidence: In [0, 1], one a vertex: how well the photographs determine it.
        expected_error: Scene units, one a vertex: its standard error across the surface, given
            the cameras.
    """

    vertices_world: Vertices
    faces: Faces
    normals_world: Vertices | None = None
    albedo: Float[Tensor, "vertex channel"] | None = None
    confidence: PerVertex | None = None
    expected_error: PerVertex | None = None

    def faults(self) -> Faults:
        """List faces that name no vertex, and vertices that are nowhere."""
        count = len(self.vertices_world)
        yield from faults_in("faces", f"indices of {count} vertices", beyond, self.faces, count)
        yield from faults_in("vertices_world", "finite vertices", not_finite, self.vertices_world)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FacetPoints(Record):
    """Points of the sparse cloud that lie on facets without being their vertices.

    Attributes:
        points_world: Where they were triangulated.
        covariance_world: Of each position, scene units squared.
        facet: The facet each point lies on, as the reference view sees it.
    """

    points_world: Points
    covariance_world: Float[Tensor, "point 3 3"]
    facet: Int[Tensor, " point"]


class Support(IntEnum):
    """The best evidence of where a facet lies."""

    NOTHING = 0
    """It closes the surface."""
    LIGHT = 1
    """Views show it lit, so that shading can tell its shape."""
    CONTOUR = 2
    """Rays through the silhouettes touch it."""
    POINTS = 3
    """Points matched between views lie on it."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CoarseMesh(Record):
    """The coarse surface, up to a few thousand facets, that patches are laid on.

    Attributes:
        mesh: The facets, with vertex normals smoothed over the mesh.
        reference: The view that the facets were triangulated in; the frontal one.
        is_point: True for vertices that are points of the sparse cloud.
        covariance_world: Of each vertex that is a point, scene units squared; zero for the
            others. ``None`` for a mesh that comes from elsewhere.
        points: The cloud between the vertices; ``None`` for a mesh from elsewhere.
        support: The best evidence of where each facet lies, a value of :class:`Support`; ``None``
            if unknown.
    """

    mesh: Mesh
    reference: int
    is_point: VertexMask
    covariance_world: Float[Tensor, "vertex 3 3"] | None = None
    points: FacetPoints | None = None
    support: Int[Tensor, " face"] | None = None
