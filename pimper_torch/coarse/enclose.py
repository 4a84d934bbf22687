"""Coarse mesh all round: facets on everything that a few views see, without a reference view."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.coarse.brought import checked
from pimper_torch.coarse.cloud import point_covariances
from pimper_torch.coarse.densify import DensifyConfig, DepthMaps
from pimper_torch.coarse.matched import matched_cloud, pixel_size
from pimper_torch.coarse.oriented import OrientedPoints
from pimper_torch.coarse.outlined import (
    FineSurface,
    OutlinedConfig,
    outlined_surface,
)
from pimper_torch.coarse.select import frontal_view, named_view
from pimper_torch.coarse.triangulate import smooth_over_mesh
from pimper_torch.coarse.trim import (
    evidence,
    point_distances,
    supported_pieces,
    too_far,
    without_small_holes,
)
from pimper_torch.config import require
from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.projection import triangulation_angles
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, Outlines, SparseScene
from pimper_torch.rims.constraints import Rim, Rims
from pimper_torch.sfm.surfaces import poisson_surface, simplified
from pimper_torch.stage import Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class EncloseConfig:
    """How the cloud becomes dense, the surface, and what of it stays.

    Lengths in pixels are those of the finest depth maps, at the cloud's median depth.

    Attributes:
        reference: Name or stem of the frontal photograph; empty chooses it.
        num_facets: About so many are left after simplification.
        min_track_length: Views that must have seen a point of the sparse cloud.
        max_reprojection_px: Mean reprojection error it may have.
        min_angle_deg: Widest angle between rays it must have.
        densify: The search for depth maps.
        outlined: The surface where outlines are known; the settings from ``max_depth`` to
            ``hole_px`` are of that where they are not.
        cell_px: The points' finest grid; the surface's own has cells twice as wide.
        max_depth: Of the surface's octree, whatever the cell.
        point_weight: Of points against smoothness, in the surface.
        reach_px: A face nearer to a point of the cloud than this is borne out by it.
        least_views: That have to see a face which is not.
        gap_px: Distance from all points of the cloud, above which seen faces without any go.
        brink_px: With them goes what hangs together with them further than this from all points.
        hole_px: Side of a square as large as the largest hole that is closed.
        min_share: Of the area borne out, that a piece apart has to have.
        boundary_weight: Of rims against the surface, in simplification.
        max_distance_px: From its facet that a point of the sparse cloud may have.
        smoothing_rounds: Of the vertex normals, over the mesh.
    """

    reference: str = ""
    num_facets: int = 3000
    min_track_length: int = 3
    max_reprojection_px: float = 1.5
    min_angle_deg: float = 4.0
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    outlined: OutlinedConfig = field(default_factory=OutlinedConfig)
    cell_px: float = 1.0
    max_depth: int = 10
    point_weight: float = 1.0
    reach_px: float = 4.0
    least_views: int = 2
    gap_px: float = 40.0
    brink_px: float = 10.0
    hole_px: float = 24.0
    min_share: float = 0.01
    boundary_weight: float = 10.0
    max_distance_px: float = 4.0
    smoothing_rounds: int = 1

    def __post_init__(self) -> None:
        require(self.num_facets >= 4, "num_facets", self.num_facets, "4 or more")
        require(self.min_track_length >= 2, "min_track_length", self.min_track_length, "2 or more")
        require(self.cell_px > 0, "cell_px", self.cell_px, "above 0")
        require(2 <= self.max_depth <= 12, "max_depth", self.max_depth, "2 to 12")
        require(self.point_weight >= 0, "point_weight", self.point_weight, "0 or more")
        require(self.reach_px > 0, "reach_px", self.reach_px, "above 0")
        require(self.least_views >= 1, "least_views", self.least_views, "1 or more")
        require(self.gap_px > 0, "gap_px", self.gap_px, "above 0")
        require(
            0 <= self.brink_px <= self.gap_px, "brink_px", self.brink_px, "in [0, enclose.gap_px]"
        )
        require(self.hole_px >= 0, "hole_px", self.hole_px, "0 or more")
        require(0 <= self.min_share < 1, "min_share", self.min_share, "in [0, 1)")
        require(self.max_distance_px > 0, "max_distance_px", self.max_distance_px, "above 0")


class Enclose(Stage):
    """Enclose the object in facets; the result is a constant to autograd."""

    def __init__(self, config: EncloseConfig | None = None) -> None:
        super().__init__()
        self.config = config or EncloseConfig()

    @torch.no_grad()
    def forward(
        self,
        scene: SparseScene,
        mesh: Mesh | None = None,
        outlines: Outlines | None = None,
        rims: Rims | None = None,
    ) -> CoarseMesh:
        """Make the coarse mesh of depth maps and outlines, or of a mesh that is given.

        Args:
            scene: Photographs, cameras and cloud.
            mesh: A surface in the scene's frame, used instead of the photographs' own.
            outlines: Where views show the object: all of that gets facets, and nothing else
                does. ``None``: everything is the object, and what no point is near to gets none.
            rims: What the outlines say about the surface; made of them when left out.

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
        trusted = self.trusted(scene)
        if rims is None and mesh is None:
            rims = Rim()(outlines, scene.cameras)
        fine: FineSurface | None = None
        if mesh is not None:
            vertices, faces = checked(mesh, scene.cameras)
            pixel = pixel_size(scene, trusted) if len(trusted) else float("inf")
        elif outlines is not None and rims is not None:
            trusted = trusted[rims.hull.depth_of(scene.points_world[trusted]) > 0]
            fine = outlined_surface(scene, trusted, outlines, rims, config.densify, config.outlined)
            vertices, faces, pixel = fine.vertices_world, fine.faces, fine.pixel
        else:
            vertices, faces, pixel = self.surface(scene, trusted)
        if len(faces) > config.num_facets:
            vertices, faces = _few(vertices, faces, config)
        if mesh is None:
            faces = two_faces_an_edge(vertices, faces)
            whole = torch.ones_like(faces[:, 0], dtype=torch.bool)
            pieces = supported_pieces(vertices, faces, whole, config.min_share)
            vertices, faces = _used(vertices, faces[pieces])
        normals = smooth_over_mesh(vertex_normals(vertices, faces), faces, config.smoothing_rounds)
        return CoarseMesh(
            mesh=Mesh(vertices_world=vertices, faces=faces, normals_world=normals),
            reference=reference,
            is_point=torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device),
            covariance_world=torch.zeros_like(vertices)[:, :, None].expand(-1, 3, 3),
            points=self._on_facets(scene, trusted, vertices, faces, pixel),
            support=None if fine is None else fine.support_of(vertices[faces]),
        )

    def surface(
        self, scene: SparseScene, trusted: Int[Tensor, " trusted"]
    ) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"], float]:
        """Give the surface before simplification, and the size of a pixel there."""
        config = self.config
        if len(trusted) < 4:
            raise ReconstructionError(
                f"coarse mesh: {len(trusted)} of {len(scene.points_world)} sparse points can be "
                "trusted, and at least 4 are needed. Take more photographs, or relax the filters "
                "of `enclose`."
            )
        cloud, maps, pixel = matched_cloud(scene, trusted, config.densify, config.cell_px)
        if len(cloud.points_world) < 16:
            raise ReconstructionError(
                f"coarse mesh: {len(cloud.points_world)} points were matched between the "
                "photographs, and a surface needs some hundreds. Take photographs that overlap "
                "more, or bring a mesh of your own."
            )
        vertices, faces = self._closed(cloud, pixel)
        kept = self._borne_out(vertices, faces, cloud, maps, pixel)
        if not bool(kept.any()):
            raise ReconstructionError(
                f"coarse mesh: none of {len(faces)} faces is borne out by the photographs. "
                "Lower `enclose.least_views`, raise `enclose.reach_px`, or bring a mesh."
            )
        return *_used(vertices, faces[kept]), pixel

    def trusted(self, scene: SparseScene) -> Int[Tensor, " trusted"]:
        """List the points of the cloud that enough views saw well enough."""
        config, observed = self.config, scene.observed
        angle = triangulation_angles(scene.points_world, observed, scene.cameras.centers_world)
        trusted = (
            (observed.sum(dim=1) >= config.min_track_length)
            & (scene.reprojection_errors_px <= config.max_reprojection_px)
            & (angle >= torch.deg2rad(angle.new_tensor(config.min_angle_deg)))
        )
        return trusted.nonzero()[:, 0]

    def _closed(
        self, cloud: OrientedPoints, pixel: float
    ) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
        points = cloud.points_world
        extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
        cells = extent / (2 * self.config.cell_px * pixel)
        depth = min(self.config.max_depth, max(4, round(math.log2(cells))))
        # COLMAP works in single precision: a cloud far from the origin is brought there.
        middle = points.median(dim=0).values
        vertices, faces = poisson_surface(
            points - middle,
            cloud.normals_world,
            depth=depth,
            point_weight=self.config.point_weight,
        )
        return vertices.to(points) + middle, faces.to(points.device)

    def _borne_out(
        self,
        vertices: Float[Tensor, "vertex 3"],
        faces: Int[Tensor, "face 3"],
        cloud: OrientedPoints,
        maps: DepthMaps,
        pixel: float,
    ) -> Bool[Tensor, " face"]:
        config = self.config
        said = evidence(vertices, faces, maps.level, maps)
        middle = vertices[faces].mean(dim=1)
        distance = point_distances(middle, cloud.points_world)
        supported = distance <= config.reach_px * pixel
        kept = (said.seen >= config.least_views) & supported
        between = (said.lit >= config.least_views) & (said.denied < config.least_views)
        between &= ~supported
        kept |= between & ~too_far(
            faces, between, distance, config.gap_px * pixel, config.brink_px * pixel
        )
        kept = without_small_holes(vertices, faces, kept, (config.hole_px * pixel) ** 2)
        chosen = kept.nonzero()[:, 0]
        pieces = supported_pieces(vertices, faces[chosen], supported[chosen], config.min_share)
        kept[chosen[~pieces]] = False
        return kept

    def _on_facets(
        self,
        scene: SparseScene,
        trusted: Int[Tensor, " trusted"],
        vertices: Float[Tensor, "vertex 3"],
        faces: Int[Tensor, "face 3"],
        pixel: float,
    ) -> FacetPoints:
        surface = NearestSurface(Mesh(vertices_world=vertices, faces=faces))
        found = surface.query(scene.points_world[trusted])
        near = found.distance <= self.config.max_distance_px * pixel
        chosen = trusted[near]
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
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], config: EncloseConfig
) -> tuple[Float[Tensor, "left 3"], Int[Tensor, "few 3"]]:
    middle = vertices.median(dim=0).values
    fewer, left = simplified(
        vertices - middle,
        faces,
        num_faces=config.num_facets,
        boundary_weight=config.boundary_weight,
    )
    return _used(fewer.to(vertices) + middle, left.to(faces.device))


def _used(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> tuple[Float[Tensor, "used 3"], Int[Tensor, "face 3"]]:
    used, faces = torch.unique(faces, return_inverse=True)
    return vertices[used], faces
