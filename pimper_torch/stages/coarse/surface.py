"""The coarse mesh: a surface through the point cloud and the contours, simplified to facets."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.poisson import reduced
from pimper_torch.geometry.projection import triangulation_angles
from pimper_torch.geometry.rigid import transform
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.topology import face_counts, face_edges, half_edges
from pimper_torch.records import (
    CoarseMesh,
    FacetPoints,
    Mesh,
    OrientedPoints,
    Silhouettes,
    SparseScene,
)
from pimper_torch.records.shapes import Faces, Vertices
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.stages.coarse.coarse_config import CoarseSurfaceConfig
from pimper_torch.stages.coarse.fine_surface import fine_surface
from pimper_torch.stages.coarse.given_mesh import oriented_outward, prepared
from pimper_torch.stages.coarse.oriented import pixel_size
from pimper_torch.stages.coarse.reference import reference_view
from pimper_torch.stages.coarse.trim import min_fraction, supported_components
from pimper_torch.stages.stage import Stage

# Largest distance of a cloud's point to its facet, in pixels of the finest depth maps. A choice.
_ON_FACET_PX = 4.0

# Requirements for a reliable point: views, mean reprojection error, widest angle between its rays.
# Choices: two views of a wrong match always agree, three seldom; narrower angles: poor depth.
_MIN_TRACK, _MAX_ERROR_PX, _MIN_ANGLE_DEG = 3, 1.5, 4.0


class CoarseSurface(Stage):
    """Compute the coarse mesh of the object, a few thousand facets. Not differentiable."""

    kept_as = CoarseMesh

    def __init__(self, config: CoarseSurfaceConfig | None = None) -> None:
        super().__init__()
        self.config = config or CoarseSurfaceConfig()

    @torch.no_grad()
    def forward(
        self,
        scene: SparseScene,
        contours: Contours,
        mesh: Mesh | None = None,
        more: OrientedPoints | None = None,
    ) -> CoarseMesh:
        """Compute the coarse mesh from depth maps and silhouettes, or from a given mesh.

        Args:
            contours: Of the silhouettes: all of the object gets facets, and nothing else does.
                Silhouettes that constrain nothing: surface far from all points gets no facets.
            mesh: A surface in the scene's frame, used instead of reconstructing one.
            more: Points of the surface in addition to the matched ones. They cover all of the
                object: connected components without points are removed.

        Raises:
            InputError: No registered photograph has the reference's name, or no camera sees the
                given mesh.
            ReconstructionError: Too few points are reliable or matched, or the photographs
                support no face.
        """
        reference = reference_view(scene, self.config.reference)
        reliable, count = reliable_points(scene), self.config.num_facets
        if mesh is not None:
            vertices, faces = oriented_outward(mesh, scene.cameras)
            simple = reduced(Mesh(vertices_world=vertices, faces=faces), count)
            vertices, faces = simple.vertices_world, simple.faces
            pixel = pixel_size(scene, reliable) if len(reliable) else float("inf")
            support = None
        else:
            within = contours.hull.depth_of(points := scene.points_world[reliable]) > 0
            leave_out("coarse.hull", ~within, at=points)
            reliable = reliable[within]
            if len(reliable) < 4 and not contours.confine:
                raise ReconstructionError(
                    f"coarse mesh: {len(reliable)} of {len(scene.points_world)} sparse points are "
                    f"reliable (at least {_MIN_TRACK} views and {_MIN_ANGLE_DEG} degrees, at most "
                    f"{_MAX_ERROR_PX} px); needed: at least 4. Take more photographs."
                )
            fine = fine_surface(scene, reliable, contours, self.config.levels, more)
            simple = reduced(Mesh(vertices_world=fine.vertices_world, faces=fine.faces), count)
            vertices, total = simple.vertices_world, len(simple.faces)
            faces = limit_faces_per_edge(vertices, simple.faces)
            leave_out("coarse.crowded", total - len(faces), total=total)
            supported = torch.ones_like(faces[:, 0], dtype=torch.bool)
            kept = supported_components(vertices, faces, supported, min_fraction(contours))
            leave_out("coarse.pieces", ~kept)
            used, faces = torch.unique(faces[kept], return_inverse=True)
            vertices = vertices[used]
            pixel, support = fine.pixel, fine.support_of(vertices[faces])
        tolerance = _ON_FACET_PX * pixel
        coarse = _with_points(scene, reliable, reference, vertices, faces, tolerance)
        return coarse.replace(support=support)


@isolated
@torch.no_grad()
def facets_of(mesh: Mesh, scene: SparseScene, reference: str = "") -> CoarseMesh:
    """Return a coarse mesh with the faces of a mesh as facets, and the cloud's points on them.

    Coincident vertices are welded, faces without area and duplicate faces are removed, and fronts
    face the cameras. Nothing is simplified: chains expect some hundreds to thousands of faces.

    Args:
        reference: Name or stem of the frontal photograph; empty selects it automatically.

    Raises:
        InputError: The mesh is not a surface, is not in the cameras' frame, or is seen by no
            camera; or not exactly one photograph has the reference's name.
    """
    view = reference_view(scene, reference)
    mesh, _ = prepared(mesh, scene, Silhouettes.everything(scene.views))
    vertices, faces = oriented_outward(mesh, scene.cameras)
    reliable = reliable_points(scene)
    tolerance = _ON_FACET_PX * pixel_size(scene, reliable) if len(reliable) else 0.0
    return _with_points(scene, reliable, view, vertices, faces, tolerance)


def reliable_points(scene: SparseScene) -> Int[Tensor, " reliable"]:
    """Return the indices of points with enough views, small residuals and wide angles."""
    observed = scene.observed
    angle = triangulation_angles(scene.points_world, observed, scene.cameras.centers_world)
    reliable = (
        (observed.sum(dim=1) >= _MIN_TRACK)
        & (scene.reprojection_errors_px <= _MAX_ERROR_PX)
        & (angle >= torch.deg2rad(angle.new_tensor(_MIN_ANGLE_DEG)))
    )
    leave_out("coarse.reliable", ~reliable, at=scene.points_world)
    return reliable.nonzero()[:, 0]


def smoothed_normals(vertices: Vertices, faces: Faces) -> Vertices:
    """Return unit vertex normals, each averaged with the mean normal of its neighbours."""
    normals = vertex_normals(vertices, faces)
    source = half_edges(faces[:, [2, 0, 1]])  # summed from each face's first edge on
    target = source.flip(1).flatten()
    total = torch.zeros_like(normals).index_add(0, target, normals[source.flatten()])
    return normalize(normals + normalize(total, dim=-1), dim=-1)


def limit_faces_per_edge(vertices: Vertices, faces: Faces) -> Int[Tensor, "kept 3"]:
    """Return faces, at most two per edge: of others the smallest is dropped, repeatedly."""
    while True:
        _, face_edge = face_edges(faces)
        counts = face_counts(face_edge)
        crowded = (counts[face_edge] > 2).any(dim=1)
        if not bool(crowded.any()):
            return faces
        area = face_normals(vertices, faces).norm(dim=-1)
        smallest = torch.where(crowded, area, torch.inf).argmin()
        faces = torch.cat([faces[:smallest], faces[smallest + 1 :]])


def _with_points(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    reference: int,
    vertices: Vertices,
    faces: Faces,
    max_distance: float,
) -> CoarseMesh:
    """Return the coarse mesh with the reliable points up to ``max_distance`` from a facet."""
    mesh = Mesh(vertices_world=vertices, faces=faces)
    nearest = NearestSurface(mesh).query(scene.points_world[reliable])
    near = nearest.distance <= max_distance
    return CoarseMesh(
        mesh=mesh.replace(normals_world=smoothed_normals(vertices, faces)),
        reference=reference,
        is_point=torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device),
        points=FacetPoints(
            points_world=scene.points_world[reliable[near]],
            covariance_world=point_covariances(scene, reliable[near]),
            facet=nearest.face[near],
        ),
    )


def point_covariances(
    scene: SparseScene, index: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    r"""Return the covariance of triangulated points.

    .. math:: C = \sigma^2 \Big( \sum_{views} J^T J \Big)^{-1}

    with J the derivative of the pixel with respect to the point. A point is uncertain along its
    rays, more so if it is far away or the angle between them is narrow. The pixel noise
    :math:`\sigma` is estimated from the point's mean reprojection error :math:`e` over n
    views, :math:`\sigma^2 = (2 e^2 / \pi) \, 2n / (2n - 3)` for Gaussian noise, and blended with
    the median of the cloud, because a short track hardly determines it. Cameras count as exact.

    Returns:
        Scene units squared.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 5.2, for the
    back-propagation of pixel noise.
    """
    cameras, point = scene.cameras, scene.observation_point
    view, count = scene.observation_view, len(scene.points_world)
    frames = cameras.cam_from_world[view].double()
    intrinsics = cameras.intrinsics[view].double()
    points = transform(frames, scene.points_world[point, None].double())
    depth = points[:, 0, 2, None, None]
    pixel = (points @ intrinsics.mT)[:, 0, :2, None] / depth
    inward = intrinsics.new_tensor([0, 0, 1])
    rate = (intrinsics[:, :2] - pixel * inward) / depth @ frames[:, :3, :3]
    information = rate.new_zeros(count, 3, 3).index_add(0, point, rate.mT @ rate)[index]
    # Bounds the standard deviation along rays, infinite in one view, to 1,000 times that across.
    least = 1e-6 * information.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    eye = torch.eye(3, dtype=rate.dtype, device=rate.device)
    covariance = torch.linalg.inv(information + least[:, None, None] * eye)

    views = torch.bincount(point, minlength=count).double()
    freedom = (2 * views - 3).clamp_min(1)
    error = scene.reprojection_errors_px.double()
    noise = 2 / torch.pi * error.square() * 2 * views / freedom
    common = noise.median()
    # The median counts as the residuals of two tracks of three views.
    blended = (6 * common + freedom * noise) / (6 + freedom)
    return (blended[index, None, None] * covariance).to(scene.points_world)
