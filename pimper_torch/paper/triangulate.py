"""Coarse mesh of a few hundred facets between points of the cloud, in the frontal view."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.geometry.surfaces import side_lengths, unit_face_normals
from pimper_torch.geometry.topology import face_components, face_counts, face_edges
from pimper_torch.paper import cloud_filters
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.records import Cameras, CoarseMesh, FacetPoints, Mesh, SparseScene, Views
from pimper_torch.records.shapes import FaceMask, Faces, Mask, Vertices
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.coarse.reference import reference_view
from pimper_torch.stages.coarse.surface import point_covariances, reliable_points, smoothed_normals
from pimper_torch.stages.stage import Stage

# All constants are choices, the same for all photographs. A point must be observed by a view with
# an axis within this angle of the reference's.
_MAX_VIEW_ANGLE_DEG = 40.0

# A facet tilted more from the reference bridges a depth discontinuity; so does one tilted by more
# than the second angle with an edge longer than this multiple of the median facet's.
_MAX_TILT_DEG, _BRIDGE_TILT_DEG, _MAX_STRETCH = 80.0, 60.0, 3.0

# On the border a facet is dropped below any of these: height over longest edge in the image, angle
# at a corner of no other facet, fraction of its area on the object.
_MIN_ALTITUDE, _MIN_TIP_DEG, _MIN_COVERAGE = 0.08, 45.0, 0.6


class Triangulate(Stage):
    """Triangulate reliable points of the cloud. Not differentiable."""

    kept_as = CoarseMesh

    def __init__(self, config: TriangulateConfig | None = None) -> None:
        super().__init__()
        self.config = config or TriangulateConfig()

    @torch.no_grad()
    def forward(self, scene: SparseScene) -> CoarseMesh:
        """Return the coarse mesh of the cloud, triangulated in the reference view.

        Raises:
            InputError: No registered photograph has the reference's name.
            ReconstructionError: Fewer than four points pass the filters, or no facet does.
        """
        reference = reference_view(scene, self.config.reference)
        camera = scene.cameras.cam_from_world[reference], scene.cameras.intrinsics[reference]
        reliable, quality = self._reliable(scene, reference)
        pixels, _ = project(scene.points_world[reliable], *camera)
        quality = torch.where(cloud_filters.on_hull(pixels), quality + quality.amax(), quality)
        chosen = cloud_filters.spread_to_count(pixels, quality, self.config.num_points)
        source = reliable[chosen]
        facets = self._facets(scene.points_world[source], scene.views, scene.cameras, reference)
        if len(facets) == 0:
            raise ReconstructionError(
                f"coarse mesh: all facets between {len(source)} points were dropped; needed: at "
                "least one. Choose a different `triangulate.reference`, or check the masks."
            )
        label = face_components(facets)
        connected = label == label.bincount().argmax()
        leave_out("triangulate.pieces", ~connected)
        used, faces = torch.unique(facets[connected], return_inverse=True)
        source = source[used]
        vertices = scene.points_world[source]
        between = reliable[~torch.isin(reliable, source)]
        pixels, _ = project(scene.points_world[between], *camera)
        facet = cloud_filters.facets_under(pixels, project(vertices[faces], *camera)[0])
        between, facet = between[facet >= 0], facet[facet >= 0]
        return CoarseMesh(
            mesh=Mesh(
                vertices_world=vertices,
                faces=faces,
                normals_world=smoothed_normals(vertices, faces),
            ),
            reference=reference,
            is_point=torch.ones_like(source, dtype=torch.bool),
            covariance_world=point_covariances(scene, source),
            points=FacetPoints(
                points_world=scene.points_world[between],
                covariance_world=point_covariances(scene, between),
                facet=facet,
            ),
        )

    def _reliable(
        self, scene: SparseScene, reference: int
    ) -> tuple[Int[Tensor, " reliable"], Float[Tensor, " reliable"]]:
        """Return the points that pass every filter, and their quality."""
        cameras, observed = scene.cameras, scene.observed
        cam_from_world = cameras.cam_from_world[reference]
        axes = cameras.cam_from_world[:, 2, :3]
        near = axes @ axes[reference] >= torch.deg2rad(axes.new_tensor(_MAX_VIEW_ANGLE_DEG)).cos()
        pixels, depth = project(scene.points_world, cam_from_world, cameras.intrinsics[reference])
        within = ((pixels > 0) & (pixels < cameras.sizes_px[reference])).all(dim=1) & (depth > 0)
        points_cam = transform(cam_from_world, scene.points_world)

        def visible(index: Int[Tensor, " point"]) -> Bool[Tensor, " point"]:
            seen = observed[index, reference]
            return ~cloud_filters.occluded_points(pixels[index], points_cam[index], seen)

        filters = (
            lambda index: (within & observed[:, near].any(dim=1))[index],
            visible,
            visible,  # again, without points that seemed to be occluders
            lambda index: cloud_filters.consistent_points(pixels[index], points_cam[index]),
            lambda index: cloud_filters.without_isolated_corners(pixels[index]),
        )
        before = index = reliable_points(scene)
        for passes in filters:
            if len(index) >= 4:
                index = index[passes(index)]
        leave_out("triangulate.reliable", ~torch.isin(before, index), at=scene.points_world[before])
        if len(index) < 4:
            raise ReconstructionError(
                f"coarse mesh: {len(index)} of {len(depth)} sparse points are reliable and seen "
                f"near {scene.views.names[reference]}; needed: at least 4. Take more photographs "
                "near the frontal one, or choose a different `triangulate.reference`."
            )
        errors = scene.reprojection_errors_px[index]
        quality = observed[index].sum(dim=1).to(scene.points_world) - errors
        return index, quality + 3 * observed[index, reference].to(quality)

    def _facets(self, vertices: Vertices, views: Views, cameras: Cameras, reference: int) -> Faces:
        """Return Delaunay facets without bridges, and without background at the border."""
        camera = cameras.cam_from_world[reference], cameras.intrinsics[reference]
        pixels, _ = project(vertices, *camera)
        faces = cloud_filters.delaunay(pixels)
        normals = unit_face_normals(vertices, faces)
        to_camera = normalize(
            cameras.centers_world[reference] - vertices[faces].mean(dim=1), dim=-1
        )
        facing = (normals * to_camera).sum(dim=-1)
        steepest, bridge = torch.deg2rad(facing.new_tensor([_MAX_TILT_DEG, _BRIDGE_TILT_DEG])).cos()
        longest = side_lengths(vertices[faces]).amax(dim=1)
        far = longest > _MAX_STRETCH * longest.median()
        faces = faces[(facing > steepest) & ~(far & (facing < bridge))]
        gray = views.images[reference].mean(dim=0)
        u, v = pixels.long().unbind(dim=1)
        at_vertices = gray[v.clamp(0, gray.shape[0] - 1), u.clamp(0, gray.shape[1] - 1)]
        foreground = gray > 0.12 * at_vertices.median()  # darker is background
        if views.masks is not None:
            foreground = foreground & views.masks[reference]
        corners = pixels[faces]
        coverage = _coverage(corners, foreground)
        ahead, back = corners.roll(-1, dims=1) - corners, corners.roll(1, dims=1) - corners
        (ux, uy), (vx, vy) = ahead[:, 0].mT, back[:, 0].mT
        square = side_lengths(corners).amax(dim=1).square().clamp_min(1e-30)
        thin = (ux * vy - uy * vx).abs() / square < _MIN_ALTITUDE
        cosine = (normalize(ahead, dim=-1) * normalize(back, dim=-1)).sum(dim=-1)
        spikes = cosine > torch.deg2rad(cosine.new_tensor(_MIN_TIP_DEG)).cos()
        return peel(faces, (coverage < _MIN_COVERAGE) | thin, spikes)


def peel(faces: Faces, unwanted: FaceMask, sharp: Bool[Tensor, "face 3"]) -> Int[Tensor, "kept 3"]:
    """Return faces, with unwanted ones dropped repeatedly from the border so that no hole opens.

    Args:
        unwanted: Faces to drop if they have an edge on the border.
        sharp: Sharp corners; a face with one between two border edges is dropped, too.
    """
    while True:
        _, opposite = face_edges(faces)
        alone = face_counts(opposite)[opposite] == 1
        on_border = alone.roll(1, dims=1)  # the first edge runs from the first corner
        # Corner i is between edges i - 1 and i.
        tips = on_border & on_border.roll(1, dims=1) & sharp
        drop = (on_border.any(dim=1) & unwanted) | tips.any(dim=1)
        if not drop.any():
            return faces
        faces, unwanted, sharp = faces[~drop], unwanted[~drop], sharp[~drop]


def _coverage(corners_px: Float[Tensor, "face 3 2"], foreground: Mask) -> Float[Tensor, " face"]:
    """Return the foreground fraction of each triangle's pixels."""
    steps = [(a, b, 9 - a - b) for a in range(10) for b in range(10 - a)]
    weights = corners_px.new_tensor(steps) * (1 - 3 / 27) / 9 + 1 / 27  # a little inside
    height, width = foreground.shape
    sampled = grid_sample(
        foreground[None, None].to(corners_px),
        grid_from_pixels(weights @ corners_px, width, height)[None],
        mode="nearest",
        align_corners=False,
    )
    return sampled[0, 0].mean(dim=-1)
