"""The coarse mesh: a surface through the cloud and the contours, simplified to facets."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.nearest import NearestSurface
from pimper_torch.ground.geometry.poisson import reduced
from pimper_torch.ground.geometry.projection import triangulation_angles
from pimper_torch.ground.geometry.rigid import transform
from pimper_torch.ground.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.ground.geometry.topology import face_counts, face_edges, half_edges
from pimper_torch.ground.shapes import Faces, Vertices
from pimper_torch.method.coarse.coarse_config import CoarseSurfaceConfig
from pimper_torch.method.coarse.fine_surface import fine_surface
from pimper_torch.method.coarse.given_mesh import oriented_outward, prepared
from pimper_torch.method.coarse.oriented import pixel_size
from pimper_torch.method.coarse.reference import reference_view
from pimper_torch.method.coarse.trim import min_fraction, supported_components
from pimper_torch.records import (
    CoarseMesh,
    FacetPoints,
    Mesh,
    OrientedPoints,
    Silhouettes,
    SparseScene,
)
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.stage import Stage

# Pixels of the finest depth maps between a facet and the points of the cloud on it. A choice.
_ON_FACET_PX = 4.0

# Of a reliable point of the cloud: views, mean reprojection error, widest angle between its rays.
# Choices: two views of a wrong match always agree, three seldom; narrower angles leave depth
# uncertain.
_MIN_TRACK, _MAX_ERROR_PX, _MIN_ANGLE_DEG = 3, 1.5, 4.0


class CoarseSurface(Stage):
    """Compute the coarse surface of the object, a few thousand facets; not differentiable."""

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
        """Make the coarse mesh of depth maps and silhouettes, or of a given mesh.

        Args:
            contours: Of the silhouettes: all of the object gets facets, and nothing else does.
                Where they constrain nothing, surface far from all points gets none.
            mesh: A surface in the scene's frame, used in place of the photographs' own.
            more: Points of the surface beside those that are matched. They are on every piece of
                it: pieces without points go.

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
            few = reduced(Mesh(vertices_world=vertices, faces=faces), count)
            vertices, faces = few.vertices_world, few.faces
            pixel = pixel_size(scene, reliable) if len(reliable) else float("inf")
            support = None
        else:
            within = contours.hull.depth_of(points := scene.points_world[reliable]) > 0
            leave_out("coarse.hull", ~within, at=points)
            reliable = reliable[within]
            if len(reliable) < 4 and not contours.confine:
                raise ReconstructionError(
                    f"coarse mesh: {len(reliable)} of {len(scene.points_world)} sparse points are "
                    f"reliable ({_MIN_TRACK} views, {_MAX_ERROR_PX} px, {_MIN_ANGLE_DEG} "
                    "degrees), and at least 4 are needed. Take more photographs."
                )
            fine = fine_surface(scene, reliable, contours, self.config.levels, more)
            few = reduced(Mesh(vertices_world=fine.vertices_world, faces=fine.faces), count)
            vertices, crowded = few.vertices_world, len(few.faces)
            faces = two_faces_an_edge(vertices, few.faces)
            leave_out("coarse.crowded", crowded - len(faces), total=crowded)
            whole = torch.ones_like(faces[:, 0], dtype=torch.bool)
            kept = supported_components(vertices, faces, whole, min_fraction(contours))
            leave_out("coarse.pieces", ~kept)
            used, faces = torch.unique(faces[kept], return_inverse=True)
            vertices = vertices[used]
            pixel, support = fine.pixel, fine.support_of(vertices[faces])
        near = _ON_FACET_PX * pixel
        coarse = _with_points(scene, reliable, reference, vertices, faces, near)
        return coarse.replace(support=support)


@torch.no_grad()
def facets_of(mesh: Mesh, scene: SparseScene, reference: str = "") -> CoarseMesh:
    """Take the faces of a mesh for facets, with the points of the cloud that lie on them.

    Vertices at one place are welded, faces without area or that stand twice are left out, fronts
    turned to the cameras. The number of faces stays: a chain wants some hundreds to thousands.

    Args:
        reference: Name or stem of the frontal photograph; empty chooses it.

    Raises:
        InputError: The mesh is no surface, in another frame than the cameras, or seen by none; no
            one photograph has the reference's name.
    """
    view = reference_view(scene, reference)
    mesh, _ = prepared(mesh, scene, Silhouettes.everything(scene.views))
    vertices, faces = oriented_outward(mesh, scene.cameras)
    reliable = reliable_points(scene)
    near = _ON_FACET_PX * pixel_size(scene, reliable) if len(reliable) else 0.0
    return _with_points(scene, reliable, view, vertices, faces, near)


def reliable_points(scene: SparseScene) -> Int[Tensor, " reliable"]:
    """List the points of the cloud with enough views, small residuals and wide angles."""
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
    """Average each vertex normal with the mean of those of its neighbours; unit."""
    normals = vertex_normals(vertices, faces)
    source = half_edges(faces[:, [2, 0, 1]])  # summed from each face's first edge on
    target = source.flip(1).flatten()
    total = torch.zeros_like(normals).index_add(0, target, normals[source.flatten()])
    return normalize(normals + normalize(total, dim=-1), dim=-1)


def two_faces_an_edge(vertices: Vertices, faces: Faces) -> Int[Tensor, "kept 3"]:
    """Drop the smallest face of edges with three or more until each has two at most."""
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
    """Put the reliable points of the cloud that lie near a facet beside the facets."""
    mesh = Mesh(vertices_world=vertices, faces=faces)
    found = NearestSurface(mesh).query(scene.points_world[reliable])
    near = found.distance <= max_distance
    return CoarseMesh(
        mesh=mesh.replace(normals_world=smoothed_normals(vertices, faces)),
        reference=reference,
        is_point=torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device),
        covariance_world=torch.zeros_like(vertices)[:, :, None].expand(-1, 3, 3),
        points=FacetPoints(
            points_world=scene.points_world[reliable[near]],
            covariance_world=point_covariances(scene, reliable[near]),
            facet=found.face[near],
        ),
    )


def point_covariances(
    scene: SparseScene, index: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    r"""Return the covariance of triangulated points.

    .. math:: C = \sigma^2 \Big( \sum_{views} J^T J \Big)^{-1}

    with J the derivative of the pixel by the point: a point is uncertain along its rays, the
    more so the farther it is and the narrower the angle between them. The pixel's noise
    :math:`\sigma` is estimated from the point's mean reprojection error :math:`e` over n
    views, :math:`\sigma^2 = (2 e^2 / \pi) \, 2n / (2n - 3)` for Gaussian noise, blended with
    the median of the cloud, as a short track says little about its own noise. Cameras are
    taken as exact.

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
    # A depth has a standard deviation of at most 1,000 times that across, as in one view.
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
