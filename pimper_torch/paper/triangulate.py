"""Coarse mesh: a few hundred facets through the cloud, seen from the frontal view."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.ground.geometry.pixels import grid_from_pixels
from pimper_torch.ground.geometry.projection import project, rays_through, triangulation_angles
from pimper_torch.ground.geometry.rigid import transform
from pimper_torch.ground.geometry.surfaces import side_lengths, unit_face_normals
from pimper_torch.ground.geometry.topology import face_components, face_edges
from pimper_torch.method.coarse.reference import reference_view
from pimper_torch.method.coarse.surface import smoothed_normals
from pimper_torch.paper import cloud_filters
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.records import Cameras, CoarseMesh, Mesh, SparseScene, Views
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.stage import Stage

# All constants are choices, the same for all photographs. A point of the cloud is reliable if a
# view within this angle of the reference sees it, and by its number of views, its mean
# reprojection error and the widest angle between its rays.
_MAX_VIEW_ANGLE_DEG, _MIN_TRACK, _MAX_ERROR_PX, _MIN_ANGLE_DEG = 40.0, 3, 1.5, 4.0

# Points of the neighbourhood that a reliable one agrees with: in slope (depth over lateral
# distance), in distance from the neighbours' plane (in radii of the neighbourhood), and in
# isolation (distance to its neighbours over theirs to their own) where it is a corner of the hull.
_NEIGHBOURS, _MAX_SLOPE, _MAX_DEVIATION, _MAX_ISOLATION = 12, 6.0, 0.5, 3.0

# A facet turned further from the reference bridges a depth discontinuity; so does one turned by
# more than the second with an edge so many times the median facet's.
_MAX_TILT_DEG, _BRIDGE_TILT_DEG, _MAX_STRETCH = 80.0, 60.0, 3.0

# On the border a facet is dropped with a smaller height over its longest edge in the image, or with
# a smaller angle at a corner that it alone reaches, or with a smaller fraction of it on the object.
_MIN_ALTITUDE, _MIN_TIP_DEG, _MIN_COVERAGE = 0.08, 45.0, 0.6


class Triangulate(Stage):
    """Triangulate reliable points of the cloud; the result is a constant to autograd."""

    def __init__(self, config: TriangulateConfig | None = None) -> None:
        super().__init__()
        self.config = config or TriangulateConfig()

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
        quality = torch.where(cloud_filters.on_hull(pixels), quality + quality.amax(), quality)
        edge_px = _edge_for(config.num_points, pixels)
        if config.fill:  # filled vertices count too: do not crowd where points are dense
            chosen = cloud_filters.spread(pixels, quality, 0.7 * edge_px)
        else:
            chosen = cloud_filters.spread_to_count(pixels, quality, config.num_points)
        vertices = points[chosen]
        source = index[chosen]
        faces = self._facets(vertices, scene.views, cameras, reference)
        if config.fill:
            filled = self._filled(vertices, faces, points, cameras, reference, edge_px)
            vertices = torch.cat([vertices, filled])
            source = torch.cat([source, torch.full_like(source[:1], -1).expand(len(filled))])
            faces = self._facets(vertices, scene.views, cameras, reference)
        connected = largest_component(faces)
        lost = len(faces) - len(connected)
        leave_out("triangulate.pieces", lost, total=len(faces))
        faces = connected
        if len(faces) == 0:
            raise ReconstructionError(
                f"coarse mesh: all facets between {len(vertices)} points were dropped, and at "
                "least one is needed. Choose another `triangulate.reference`, or look at the masks."
            )
        used, faces = torch.unique(faces, return_inverse=True)
        vertices = vertices[used]
        normals = smoothed_normals(vertices, faces)
        mesh = Mesh(vertices_world=vertices, faces=faces, normals_world=normals)
        return cloud_filters.with_cloud(scene, index, mesh, reference, source[used])

    def _reliable(
        self, scene: SparseScene, reference: int
    ) -> tuple[Int[Tensor, " reliable"], Float[Tensor, " reliable"]]:
        """List the points that pass every filter, and how good each is."""
        cameras, observed = scene.cameras, scene.observed
        length = observed.sum(dim=1)
        angle = triangulation_angles(scene.points_world, observed, cameras.centers_world)
        near = cloud_filters.views_near(cameras, reference, _MAX_VIEW_ANGLE_DEG)
        pixels, depth = _project(scene.points_world, cameras, reference)
        within = ((pixels > 0) & (pixels < cameras.sizes_px[reference])).all(dim=1) & (depth > 0)
        tests = {
            f"in front of {scene.views.names[reference]} and inside its frame": within,
            "seen by a view near it": observed[:, near].any(dim=1),
            f"seen by {_MIN_TRACK} views or more": length >= _MIN_TRACK,
            f"reprojected within {_MAX_ERROR_PX} px": (
                scene.reprojection_errors_px <= _MAX_ERROR_PX
            ),
            f"seen under {_MIN_ANGLE_DEG} degrees or more": (
                angle >= torch.deg2rad(angle.new_tensor(_MIN_ANGLE_DEG))
            ),
        }
        keep = torch.stack(list(tests.values())).all(dim=0)
        index = keep.nonzero()[:, 0]
        for _ in range(2):  # a second look, without those that seemed to be in between
            if len(index) >= 4:
                hidden = cloud_filters.behind_others(
                    pixels[index],
                    transform(cameras.cam_from_world[reference], scene.points_world[index]),
                    observed[index, reference],
                    neighbours=min(2 * _NEIGHBOURS, len(index) - 1),
                    slope=3.0,
                )
                index = index[~hidden]
        if len(index) >= 4:
            points_cam = transform(cameras.cam_from_world[reference], scene.points_world[index])
            agree = cloud_filters.neighbours_agree(
                pixels[index],
                points_cam,
                neighbours=min(_NEIGHBOURS, len(index) - 1),
                max_slope=_MAX_SLOPE,
                max_deviation=_MAX_DEVIATION,
            )
            index = index[agree]
        if len(index) >= 4:
            index = index[cloud_filters.well_accompanied(pixels[index], _MAX_ISOLATION)]
        if len(index) < 4:
            counts = "; ".join(f"{int(passed.sum())} {test}" for test, passed in tests.items())
            raise ReconstructionError(
                f"coarse mesh: {len(index)} of {len(keep)} sparse points are reliable, and at "
                f"least 4 are needed ({counts}). Take more photographs near the frontal one, or "
                "choose another `triangulate.reference`."
            )
        left = torch.ones_like(keep).index_fill(0, index, False)
        leave_out("triangulate.reliable", left, at=scene.points_world)
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
        """Return new vertices between far-apart ones, on a spline through all reliable points."""
        pixels, _ = _project(vertices, cameras, reference)
        wanted = cloud_filters.fill_pixels(pixels, faces, edge_px)
        known, depth = _project(points, cameras, reference)
        inverse = cloud_filters.interpolate_inverse_depth(known, 1 / depth, wanted, 1e-6)
        possible = inverse > 0.5 / depth.amax()
        rays = rays_through(
            wanted[possible], cameras.cam_from_world[reference], cameras.intrinsics[reference]
        )
        return cameras.centers_world[reference] + rays / inverse[possible, None]

    def _facets(
        self, vertices: Float[Tensor, "vertex 3"], views: Views, cameras: Cameras, reference: int
    ) -> Int[Tensor, "face 3"]:
        """Triangulate, drop bridges, and peel off the border what shows no object."""
        pixels, _ = _project(vertices, cameras, reference)
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
        shows_object = gray > 0.12 * at_vertices.median()  # darker is background
        if views.masks is not None:
            shows_object = shows_object & views.masks[reference]
        shown = _shown(pixels[faces], shows_object)
        thin = _altitude(pixels[faces]) < _MIN_ALTITUDE
        spikes = _sharp(pixels[faces], _MIN_TIP_DEG)
        return peel(faces, (shown < _MIN_COVERAGE) | thin, spikes)


def peel(
    faces: Int[Tensor, "face 3"],
    unwanted: Bool[Tensor, " face"],
    sharp: Bool[Tensor, "face 3"] | None = None,
) -> Int[Tensor, "kept 3"]:
    """Drop unwanted faces on the border repeatedly; inner ones stay, so that no hole opens.

    Args:
        unwanted: Dropped as soon as they have an edge on the border.
        sharp: Corners; a face with a sharp corner between two border edges is dropped, too.
    """
    if sharp is None:
        sharp = torch.zeros_like(faces, dtype=torch.bool)
    while True:
        on_border = _border_edges(faces)
        # Corner i lies between edges i - 1 and i.
        tips = on_border & on_border.roll(1, dims=1) & sharp
        drop = (on_border.any(dim=1) & unwanted) | tips.any(dim=1)
        if not drop.any():
            return faces
        faces, unwanted, sharp = faces[~drop], unwanted[~drop], sharp[~drop]


def largest_component(faces: Int[Tensor, "face 3"]) -> Int[Tensor, "kept 3"]:
    """Keep the largest component of faces connected by edges."""
    if len(faces) == 0:
        return faces
    label = face_components(faces)
    return faces[label == label.bincount().argmax()]


def _project(
    points: Float[Tensor, "point 3"], cameras: Cameras, view: int
) -> tuple[Float[Tensor, "point 2"], Float[Tensor, " point"]]:
    return project(points, cameras.cam_from_world[view], cameras.intrinsics[view])


def _edge_for(num_points: int, pixels: Float[Tensor, "point 2"]) -> float:
    """Return the edge of the triangular grid that puts ``num_points`` on the hull's area."""
    faces = cloud_filters.delaunay(pixels)
    a, b, c = pixels[faces].unbind(dim=1)
    ab, ac = b - a, c - a
    area = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs().sum() / 2
    return float((area / num_points * 2 / 3**0.5).sqrt())


def _shown(
    corners_px: Float[Tensor, "face 3 2"], shows_object: Bool[Tensor, "height width"]
) -> Float[Tensor, " face"]:
    """Return the fraction of each triangle's pixels that show the object."""
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
    """Return the smallest height over the longest edge, in the image; 0.87 for equal sides."""
    longest = side_lengths(corners_px).amax(dim=1)
    a, b, c = corners_px.unbind(dim=1)
    ab, ac = b - a, c - a
    area = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs()
    return area / longest.square().clamp_min(1e-30)


def _sharp(corners_px: Float[Tensor, "face 3 2"], max_angle_deg: float) -> Bool[Tensor, "face 3"]:
    """Find corners with less than an angle between their edges, in the image."""
    ahead = normalize(corners_px.roll(-1, dims=1) - corners_px, dim=-1)
    back = normalize(corners_px.roll(1, dims=1) - corners_px, dim=-1)
    cosine = (ahead * back).sum(dim=-1)
    return cosine > torch.deg2rad(cosine.new_tensor(max_angle_deg)).cos()


def _border_edges(faces: Int[Tensor, "face 3"]) -> Bool[Tensor, "face 3"]:
    """Find edges of one face only, the first of which runs from its first corner to its second."""
    _, opposite = face_edges(faces)
    count = torch.bincount(opposite.flatten())
    return (count[opposite] == 1).roll(1, dims=1)  # the edge opposite to corner 2 comes first
