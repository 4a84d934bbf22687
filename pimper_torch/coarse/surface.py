"""Coarse mesh all round: facets on everything that a few views see, without a reference view."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.coarse.brought import checked
from pimper_torch.coarse.cloud import point_covariances
from pimper_torch.coarse.densify import DensifyConfig
from pimper_torch.coarse.fine_surface import (
    FineSurface,
    FineSurfaceConfig,
    fine_surface,
)
from pimper_torch.coarse.matched import pixel_size
from pimper_torch.coarse.select import frontal_view, named_view
from pimper_torch.coarse.triangulate import smooth_over_mesh
from pimper_torch.coarse.trim import (
    supported_pieces,
)
from pimper_torch.config import require
from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.projection import triangulation_angles
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, SparseScene
from pimper_torch.sfm.surfaces import simplified
from pimper_torch.silhouettes.contours import Contours
from pimper_torch.stage import Stage

# Of a mesh's border against its surface, when vertices are merged.
_BORDER_WEIGHT = 10.0

# Pixels of the finest depth maps from its facet that a point of the sparse cloud may lie.
_NEAR_PX = 4.0

# Of a point of the sparse cloud that is trusted: views that saw it, mean reprojection error, widest
# angle between its rays.
_MIN_TRACK, _MAX_ERROR_PX, _MIN_ANGLE_DEG = 3, 1.5, 4.0

# How often normals of vertices are averaged with their neighbours'.
_SMOOTHING = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseSurfaceConfig:
    """How the cloud becomes dense, the surface, and what of it stays.

    Lengths in pixels are those of the finest depth maps, at the cloud's median depth.

    Attributes:
        reference: Name or stem of the frontal photograph; empty chooses it.
        num_facets: About so many are left after simplification.
    """

    reference: str = ""
    num_facets: int = 3000

    def __post_init__(self) -> None:
        require(self.num_facets >= 4, "num_facets", self.num_facets, "4 or more")


class CoarseSurface(Stage):
    """CoarseSurface the object in facets; the result is a constant to autograd."""

    def __init__(
        self,
        config: CoarseSurfaceConfig | None = None,
        densify: DensifyConfig | None = None,
        fine: FineSurfaceConfig | None = None,
    ) -> None:
        super().__init__()
        self.config = config or CoarseSurfaceConfig()
        self.densify, self.fine = densify or DensifyConfig(), fine or FineSurfaceConfig()

    @torch.no_grad()
    def forward(
        self, scene: SparseScene, contours: Contours, mesh: Mesh | None = None
    ) -> CoarseMesh:
        """Make the coarse mesh of depth maps and silhouettes, or of a mesh that is given.

        Args:
            scene: Photographs, cameras and cloud.
            contours: What silhouettes say: all of the object gets facets, and nothing else does.
                Where they leave nothing out, what no point is near to gets none.
            mesh: A surface in the scene's frame, used instead of the photographs' own.

        Raises:
            InputError: No registered photograph has the reference's name, or the mesh that
                is given cannot be used.
            ReconstructionError: Too few points can be trusted or matched, or no face is
                borne out.
        """
        config = self.config
        if config.reference:
            reference = named_view(scene.views, config.reference)
        else:
            reference = frontal_view(scene)
        reliable = self.reliable(scene)
        fine: FineSurface | None = None
        if mesh is not None:
            vertices, faces = checked(mesh, scene.cameras)
            pixel = pixel_size(scene, reliable) if len(reliable) else float("inf")
        else:
            reliable = reliable[contours.hull.depth_of(scene.points_world[reliable]) > 0]
            if len(reliable) < 4 and not contours.confine:
                raise ReconstructionError(
                    f"coarse mesh: {len(reliable)} of {len(scene.points_world)} sparse points can "
                    f"be trusted ({_MIN_TRACK} views, {_MAX_ERROR_PX} px, {_MIN_ANGLE_DEG} "
                    "degrees), and at least 4 are needed. Take more photographs."
                )
            fine = fine_surface(scene, reliable, contours, self.densify, self.fine)
            vertices, faces, pixel = fine.vertices_world, fine.faces, fine.pixel
        if len(faces) > config.num_facets:
            vertices, faces = _few(vertices, faces, config.num_facets)
        if fine is not None:
            faces = two_faces_an_edge(vertices, faces)
            whole = torch.ones_like(faces[:, 0], dtype=torch.bool)
            pieces = supported_pieces(vertices, faces, whole, self.fine.min_fraction)
            vertices, faces = _used(vertices, faces[pieces])
        normals = smooth_over_mesh(vertex_normals(vertices, faces), faces, _SMOOTHING)
        return CoarseMesh(
            mesh=Mesh(vertices_world=vertices, faces=faces, normals_world=normals),
            reference=reference,
            is_point=torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device),
            covariance_world=torch.zeros_like(vertices)[:, :, None].expand(-1, 3, 3),
            points=_on_facets(scene, reliable, vertices, faces, pixel),
            support=None if fine is None else fine.support_of(vertices[faces]),
        )

    def reliable(self, scene: SparseScene) -> Int[Tensor, " reliable"]:
        """List the points of the cloud that enough views saw well enough."""
        observed = scene.observed
        angle = triangulation_angles(scene.points_world, observed, scene.cameras.centers_world)
        reliable = (
            (observed.sum(dim=1) >= _MIN_TRACK)
            & (scene.reprojection_errors_px <= _MAX_ERROR_PX)
            & (angle >= torch.deg2rad(angle.new_tensor(_MIN_ANGLE_DEG)))
        )
        return reliable.nonzero()[:, 0]


def _on_facets(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    pixel: float,
) -> FacetPoints:
    """List the points of the cloud that lie near a facet."""
    found = NearestSurface(Mesh(vertices_world=vertices, faces=faces)).query(
        scene.points_world[reliable]
    )
    near = found.distance <= _NEAR_PX * pixel
    chosen = reliable[near]
    return FacetPoints(
        points_world=scene.points_world[chosen],
        covariance_world=point_covariances(scene, chosen),
        facet=found.face[near],
    )


def two_faces_an_edge(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> Int[Tensor, "kept 3"]:
    """Drop the smallest face of edges with three or more until each has two at most."""
    while True:
        edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=1).values
        _, edge, counts = torch.unique(edges, dim=0, return_inverse=True, return_counts=True)
        crowded = (counts[edge] > 2).reshape(-1, 3).any(dim=1)
        if not bool(crowded.any()):
            return faces
        area = face_normals(vertices, faces).norm(dim=-1)
        smallest = torch.where(crowded, area, torch.inf).argmin()
        faces = torch.cat([faces[:smallest], faces[smallest + 1 :]])


def _few(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], count: int
) -> tuple[Float[Tensor, "left 3"], Int[Tensor, "few 3"]]:
    centre = vertices.median(dim=0).values
    fewer, left = simplified(
        vertices - centre, faces, num_faces=count, boundary_weight=_BORDER_WEIGHT
    )
    return _used(fewer.to(vertices) + centre, left.to(faces.device))


def _used(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> tuple[Float[Tensor, "used 3"], Int[Tensor, "face 3"]]:
    used, faces = torch.unique(faces, return_inverse=True)
    return vertices[used], faces
