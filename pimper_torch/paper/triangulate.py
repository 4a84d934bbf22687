"""Coarse mesh: a few hundred facets through the cloud, seen from the frontal view."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.coarse.reference import reference_view
from pimper_torch.coarse.surface import smoothed_normals
from pimper_torch.config import require
from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.components import face_components
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project, rays_through, triangulation_angles
from pimper_torch.geometry.surfaces import (
    face_normals,
    side_lengths,
)
from pimper_torch.paper.cloud import with_cloud
from pimper_torch.paper.fill import delaunay, fill_pixels, interpolate_inverse_depth
from pimper_torch.paper.filters import (
    behind_others,
    neighbours_agree,
    on_hull,
    spread,
    spread_to_number,
    views_near,
    well_accompanied,
)
from pimper_torch.records import Cameras, CoarseMesh, Mesh, SparseScene, Views
from pimper_torch.stage import Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class TriangulateConfig:
    """Which points become vertices, and which triangles facets.

    Attributes:
        reference: Name or stem of the frontal photograph; empty chooses it.
        num_points: About how many vertices to spread over the visible side.
        fill: Put vertices on a smooth surface where the cloud has none.
    """

    reference: str = ""
    num_points: int = 250
    fill: bool = True

    def __post_init__(self) -> None:
        require(self.num_points >= 4, "num_points", self.num_points, "4 or more")


@dataclass(frozen=True, slots=True, kw_only=True)
class TriangulateDetails:
    """Which points and triangles count, the same for all photographs.

    Attributes:
        facet_edge_px: Distance of vertices in the reference view; 0 derives it from
            ``num_points``.
        fill_smoothing: Of that surface; 0 passes through every point.
        max_view_angle_deg: Points count that were seen by a view turned less than this
            from the reference.
        min_track_length: Views that must have seen a point.
        max_reprojection_px: Mean reprojection error a point may have.
        min_angle_deg: Widest angle between rays a point must have.
        neighbours: Points around a point that must agree with it.
        hiding_slope: Points all round that are nearer to the reference by more than this
            times their lateral distance hide a point.
        max_slope: Depth over lateral distance between agreeing points.
        max_deviation: From the plane of the neighbours, in radii of the neighbourhood.
        max_isolation: Times further from its neighbours than they from theirs that a point
            at the rim of the cloud may be.
        max_tilt_deg: A facet turned further from the reference bridges a depth
            discontinuity and is dropped.
        max_stretch: Longest edge over the median facet's, in the scene, above which a facet
            turned by more than 60 degrees is such a bridge too.
        min_altitude: Height over longest edge, in the image, below which a facet at the rim
            is dropped.
        min_tip_deg: A facet that alone reaches out to a vertex of the rim, with a smaller
            angle there, is a spike and dropped.
        min_coverage: Fraction of a facet at the rim that must show the object.
        dark_fraction: Radiance in the reference view, over the median at the mesh's vertices, at
            or below which a pixel shows background.
        smoothing_iterations: Of the vertex normals, over the mesh.
    """

    facet_edge_px: float = 0.0
    fill_smoothing: float = 1e-6
    max_view_angle_deg: float = 40.0
    min_track_length: int = 3
    max_reprojection_px: float = 1.5
    min_angle_deg: float = 4.0
    neighbours: int = 12
    hiding_slope: float = 3.0
    max_slope: float = 6.0
    max_deviation: float = 0.5
    max_isolation: float = 3.0
    max_tilt_deg: float = 80.0
    max_stretch: float = 3.0
    min_altitude: float = 0.08
    min_tip_deg: float = 45.0
    min_coverage: float = 0.6
    dark_fraction: float = 0.12
    smoothing_iterations: int = 1


class Triangulate(Stage):
    """Span facets between trustworthy points; the result is a constant to autograd."""

    def __init__(
        self, config: TriangulateConfig | None = None, details: TriangulateDetails | None = None
    ) -> None:
        super().__init__()
        self.config = config or TriangulateConfig()
        self.details = details or TriangulateDetails()

    @torch.no_grad()
    def forward(self, scene: SparseScene) -> CoarseMesh:
        """Triangulate the cloud in the reference view.

        Raises:
            InputError: No registered photograph has the reference's name.
            ReconstructionError: Fewer than four points pass the filters, or no facet does.
        """
        config, cameras = self.config, scene.cameras
        reference = reference_view(scene, config.reference)
        index, quality = self._reliable(scene, reference)
        points = scene.points_world[index]
        pixels, _ = _project(points, cameras, reference)
        quality = torch.where(on_hull(pixels), quality + quality.amax(), quality)
        edge_px = self.details.facet_edge_px
        if edge_px > 0:
            chosen = spread(pixels, quality, 0.8 * edge_px)
        else:
            edge_px = _edge_for(config.num_points, pixels)
            chosen = spread_to_number(pixels, quality, config.num_points)
            if config.fill:  # filled vertices count too: do not crowd where points are dense
                chosen = spread(pixels, quality, 0.7 * edge_px)
        vertices = points[chosen]
        source = index[chosen]
        faces = self._facets(vertices, scene.views, cameras, reference)
        if config.fill:
            filled = self._filled(vertices, faces, points, cameras, reference, edge_px)
            vertices = torch.cat([vertices, filled])
            source = torch.cat([source, torch.full_like(source[:1], -1).expand(len(filled))])
            faces = self._facets(vertices, scene.views, cameras, reference)
        faces = largest_component(faces)
        if len(faces) == 0:
            raise ReconstructionError(
                f"coarse mesh: all facets between {len(vertices)} points were dropped, and at "
                "least one is needed. Raise `triangulate.max_tilt_deg`, lower "
                "`triangulate.min_coverage`, or choose another `triangulate.reference`."
            )
        used, faces = torch.unique(faces, return_inverse=True)
        vertices = vertices[used]
        normals = smoothed_normals(vertices, faces)
        mesh = Mesh(vertices_world=vertices, faces=faces, normals_world=normals)
        return with_cloud(scene, index, mesh, reference, source[used])

    def _reliable(
        self, scene: SparseScene, reference: int
    ) -> tuple[Int[Tensor, " reliable"], Float[Tensor, " reliable"]]:
        """List the points that pass every filter, and how good each is."""
        details, cameras, observed = self.details, scene.cameras, scene.observed
        length = observed.sum(dim=1)
        angle = triangulation_angles(scene.points_world, observed, cameras.centers_world)
        near = views_near(cameras, reference, details.max_view_angle_deg)
        pixels, depth = _project(scene.points_world, cameras, reference)
        within = ((pixels > 0) & (pixels < cameras.sizes_px[reference])).all(dim=1) & (depth > 0)
        tests = {
            f"in front of {scene.views.names[reference]} and inside its frame": within,
            "seen by a view near it": observed[:, near].any(dim=1),
            f"seen by {details.min_track_length} views or more": length >= details.min_track_length,
            f"reprojected within {details.max_reprojection_px} px": (
                scene.reprojection_errors_px <= details.max_reprojection_px
            ),
            f"seen under {details.min_angle_deg} degrees or more": (
                angle >= torch.deg2rad(angle.new_tensor(details.min_angle_deg))
            ),
        }
        keep = torch.stack(list(tests.values())).all(dim=0)
        index = keep.nonzero()[:, 0]
        for _ in range(2):  # a second look, without those that seemed to be in between
            if len(index) >= 4:
                hidden = behind_others(
                    pixels[index],
                    transform(cameras.cam_from_world[reference], scene.points_world[index]),
                    observed[index, reference],
                    neighbours=min(2 * details.neighbours, len(index) - 1),
                    slope=details.hiding_slope,
                )
                index = index[~hidden]
        if len(index) >= 4:
            points_cam = transform(cameras.cam_from_world[reference], scene.points_world[index])
            agree = neighbours_agree(
                pixels[index],
                points_cam,
                neighbours=min(details.neighbours, len(index) - 1),
                max_slope=details.max_slope,
                max_deviation=details.max_deviation,
            )
            index = index[agree]
        if len(index) >= 4:
            index = index[well_accompanied(pixels[index], details.max_isolation)]
        if len(index) < 4:
            counts = "; ".join(f"{int(passed.sum())} {test}" for test, passed in tests.items())
            raise ReconstructionError(
                f"coarse mesh: {len(index)} of {len(keep)} sparse points can be trusted, and at "
                f"least 4 are needed ({counts}). Take more photographs near the frontal one, "
                "choose another `triangulate.reference`, or relax the filters of `triangulate`."
            )
        quality = length[index].to(angle) - scene.reprojection_errors_px[index]
        seen = observed[index, reference].to(quality)
        return index, quality + 3 * seen

    def _filled(
        self,
        vertices: Float[Tensor, "vertex 3"],
        faces: Int[Tensor, "face 3"],
        points: Float[Tensor, "point 3"],
        cameras: Cameras,
        reference: int,
        edge_px: float,
    ) -> Float[Tensor, "filled 3"]:
        """Give new vertices between far-apart ones, on a spline through all trusted points."""
        pixels, _ = _project(vertices, cameras, reference)
        wanted = fill_pixels(pixels, faces, edge_px)
        known, depth = _project(points, cameras, reference)
        inverse = interpolate_inverse_depth(known, 1 / depth, wanted, self.details.fill_smoothing)
        possible = inverse > 0.5 / depth.amax()
        rays = rays_through(
            wanted[possible], cameras.cam_from_world[reference], cameras.intrinsics[reference]
        )
        return cameras.centers_world[reference] + rays / inverse[possible, None]

    def _facets(
        self,
        vertices: Float[Tensor, "vertex 3"],
        views: Views,
        cameras: Cameras,
        reference: int,
    ) -> Int[Tensor, "face 3"]:
        """Triangulate, drop bridges, and peel what shows no object off the rim."""
        pixels, _ = _project(vertices, cameras, reference)
        faces = delaunay(pixels)
        normals = normalize(face_normals(vertices, faces), dim=-1)
        to_camera = normalize(
            cameras.centers_world[reference] - vertices[faces].mean(dim=1), dim=-1
        )
        facing = (normals * to_camera).sum(dim=-1)
        steepest = torch.deg2rad(facing.new_tensor(self.details.max_tilt_deg)).cos()
        longest = side_lengths(vertices[faces]).amax(dim=1)
        far = longest > self.details.max_stretch * longest.median()
        faces = faces[(facing > steepest) & ~(far & (facing < 0.5))]  # 0.5: turned by 60 degrees
        gray = views.images[reference].mean(dim=0)
        u, v = pixels.long().unbind(dim=1)
        at_vertices = gray[v.clamp(0, gray.shape[0] - 1), u.clamp(0, gray.shape[1] - 1)]
        shows_object = gray > self.details.dark_fraction * at_vertices.median()
        if views.masks is not None:
            shows_object = shows_object & views.masks[reference]
        shown = _shown(pixels[faces], shows_object)
        thin = _altitude(pixels[faces]) < self.details.min_altitude
        spikes = _sharp(pixels[faces], self.details.min_tip_deg)
        return peel(faces, (shown < self.details.min_coverage) | thin, spikes)


def peel(
    faces: Int[Tensor, "face 3"],
    unwanted: Bool[Tensor, " face"],
    sharp: Bool[Tensor, "face 3"] | None = None,
) -> Int[Tensor, "kept 3"]:
    """Drop unwanted faces that touch the rim, again and again; inner ones stay, no holes.

    Args:
        faces: Of a mesh with a rim.
        unwanted: Dropped as soon as they touch it.
        sharp: Marks corners; a face that reaches out to one with both its edges on the rim
            is a spike, and dropped too.
    """
    if sharp is None:
        sharp = torch.zeros_like(faces, dtype=torch.bool)
    while True:
        on_rim = _rim_edges(faces)
        tips = on_rim & on_rim.roll(1, dims=1) & sharp  # corner i lies between edges i - 1 and i
        drop = (on_rim.any(dim=1) & unwanted) | tips.any(dim=1)
        if not drop.any():
            return faces
        faces, unwanted, sharp = faces[~drop], unwanted[~drop], sharp[~drop]


def largest_component(faces: Int[Tensor, "face 3"]) -> Int[Tensor, "kept 3"]:
    """Keep the largest set of faces that hang together by edges."""
    if len(faces) == 0:
        return faces
    label = face_components(faces)
    return faces[label == label.bincount().argmax()]


def _project(
    points: Float[Tensor, "point 3"], cameras: Cameras, view: int
) -> tuple[Float[Tensor, "point 2"], Float[Tensor, " point"]]:
    return project(points, cameras.cam_from_world[view], cameras.intrinsics[view])


def _edge_for(num_points: int, pixels: Float[Tensor, "point 2"]) -> float:
    """Give the edge of the triangular grid that puts ``num_points`` on the hull's area."""
    faces = delaunay(pixels)
    a, b, c = pixels[faces].unbind(dim=1)
    ab, ac = b - a, c - a
    area = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs().sum() / 2
    return float((area / num_points * 2 / 3**0.5).sqrt())


def _shown(
    corners_px: Float[Tensor, "face 3 2"], shows_object: Bool[Tensor, "height width"]
) -> Float[Tensor, " face"]:
    """Give the fraction of each triangle's pixels that show the object."""
    steps = [(a, b, 9 - a - b) for a in range(10) for b in range(10 - a)]
    weights = corners_px.new_tensor(steps) * (1 - 3 / 27) / 9 + 1 / 27  # a little inside
    height, width = shows_object.shape
    sampled = grid_sample(
        shows_object[None, None].to(corners_px),
        grid_from_pixels(weights @ corners_px, width, height)[None],
        mode="nearest",
        align_corners=False,
    )
    return sampled[0, 0].mean(dim=-1)


def _altitude(corners_px: Float[Tensor, "face 3 2"]) -> Float[Tensor, " face"]:
    """Give the smallest height over the longest edge, in the image; 0.87 for equal sides."""
    longest = side_lengths(corners_px).amax(dim=1)
    a, b, c = corners_px.unbind(dim=1)
    ab, ac = b - a, c - a
    area = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs()
    return area / longest.square().clamp_min(1e-30)


def _sharp(corners_px: Float[Tensor, "face 3 2"], max_angle_deg: float) -> Bool[Tensor, "face 3"]:
    """Mark corners with less than an angle between their edges, in the image."""
    ahead = normalize(corners_px.roll(-1, dims=1) - corners_px, dim=-1)
    back = normalize(corners_px.roll(1, dims=1) - corners_px, dim=-1)
    cosine = (ahead * back).sum(dim=-1)
    return cosine > torch.deg2rad(cosine.new_tensor(max_angle_deg)).cos()


def _rim_edges(faces: Int[Tensor, "face 3"]) -> Bool[Tensor, "face 3"]:
    """Mark edges, the first from the first corner to the second, that no other face has."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=1).values
    _, inverse, counts = torch.unique(edges, dim=0, return_inverse=True, return_counts=True)
    return (counts[inverse] == 1).reshape(-1, 3)
