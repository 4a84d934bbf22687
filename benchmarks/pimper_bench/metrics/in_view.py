"""Errors along the rays of one view: shape, normals, albedo."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from pimper_bench.metrics.surface_distances import with_surroundings
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import Hits, cast_view
from pimper_torch.records import Cameras, Mesh, Record
from pimper_torch.runtime.errors import InputError


def relative_error(
    points: Float[Tensor, "point 3"], points_true: Float[Tensor, "point 3"]
) -> Float[Tensor, ""]:
    r"""Return the published 3D error: that of points as a percentage of the true points' spread.

    .. math:: 100 \lVert S - \hat S \rVert_F / \lVert S - \bar S \rVert_F

    It is invariant to a common translation and scale. Differentiable where the points
    differ from the true ones.

    >>> square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    >>> relative_error(square + torch.tensor([0.0, 0, 0.1]), square)
    tensor(7.0711)
    """
    spread = (points_true - points_true.mean(dim=0)).norm()
    return 100 * (points - points_true).norm() / spread


def angles_deg(
    normals: Float[Tensor, "*batch 3"], normals_true: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Return the angles between vectors, also accurate for small angles."""
    sine = torch.linalg.cross(normals, normals_true).norm(dim=-1)
    cosine = (normals * normals_true).sum(dim=-1)
    return torch.rad2deg(torch.atan2(sine, cosine))


def pitted_percent(
    angle_deg: Float[Tensor, "height width"], known: Bool[Tensor, "height width"]
) -> float:
    """Return the percentage of pixels with normals 5 degrees worse than their surroundings.

    Pits hardly change the mean or the median of all normals. The surroundings, 21 x 21 pixels, must
    be less than 3 degrees off on average, so that inaccurate rims do not count.

    Args:
        angle_deg: Error of the normal; ignored where not ``known``.

    >>> angle = torch.zeros(50, 50)
    >>> angle[10, 10] = 20.0
    >>> pitted_percent(angle, torch.ones(50, 50, dtype=torch.bool))
    0.04
    """
    weight = known.double()
    sums = torch.stack([torch.where(known, angle_deg, 0).double() * weight, weight])
    total, count = avg_pool2d(sums, 21, stride=1, padding=10)
    around = total / torch.where(known, count, 1)
    pit = (around < 3.0) & (angle_deg - around > 5.0)
    return 100 * float(pit[known].double().mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class AlbedoFigures(Record):
    """Errors of albedo, which photographs determine up to scale, after fitting a scale.

    Attributes:
        one_scale_percent: ``100 ||s a - t|| / ||t||`` over samples and channels, with the
            least-squares scale ``s``.
        channel_scales_percent: The same with a scale per channel, which is invariant to the
            colour of the lights.
        one_scale_median_percent: Median of ``100 |s a - t| / t``, with ``s`` the median of
            ``t / a``: robust to outliers.
        channels: Number compared; 1 if either side is grey, and the other is then averaged.
    """

    one_scale_percent: float
    channel_scales_percent: float
    one_scale_median_percent: float
    channels: int
    samples: int


def compare_albedo(
    albedo: Float[Tensor, "sample ours"], albedo_true: Float[Tensor, "sample theirs"]
) -> AlbedoFigures | None:
    """Compare linear albedo sample by sample, up to scale.

    Returns:
        ``None`` if no sample has both: finite, and with a positive sum of channels.
    """
    ours, truth = albedo.cpu().double(), albedo_true.cpu().double()
    if ours.shape[1] != truth.shape[1]:
        ours, truth = ours.mean(dim=1, keepdim=True), truth.mean(dim=1, keepdim=True)
    valid = ours.isfinite().all(dim=1) & truth.isfinite().all(dim=1)
    valid &= (ours.sum(dim=1) > 0) & (truth.sum(dim=1) > 0)
    if not bool(valid.any()):
        return None
    ours, truth = ours[valid], truth[valid]
    scale = (ours * truth).sum() / ours.square().sum()
    channel_scales = (ours * truth).sum(dim=0) / ours.square().sum(dim=0).clamp_min(1e-300)
    positive = (ours > 0) & (truth > 0)
    t, a = truth[positive], ours[positive]
    robust = (t / a).median()
    return AlbedoFigures(
        one_scale_percent=float(100 * (scale * ours - truth).norm() / truth.norm()),
        channel_scales_percent=float(100 * (channel_scales * ours - truth).norm() / truth.norm()),
        one_scale_median_percent=float(100 * ((robust * a - t).abs() / t).median()),
        channels=ours.shape[1],
        samples=len(ours),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Meeting(Record):
    """Intersections of the rays of a view with a mesh and the truth, frame of the truth.

    Attributes:
        valid: True where a ray meets the truth.
        both: True where it meets both the truth and the mesh.
        points: On the mesh, relative to the camera's centre.
        normals_true: Zero where unknown; ``None`` if all are unknown.
    """

    valid: Bool[Tensor, "height width"]
    both: Bool[Tensor, "height width"]
    points: Float[Tensor, "ray 3"]
    points_true: Float[Tensor, "ray 3"]
    center_world: Float[Tensor, " 3"]
    hits: Hits
    faces: Int[Tensor, "face 3"]
    normals_true: Float[Tensor, "ray 3"] | None = None

    @property
    def coverage(self) -> float:
        """Fraction of the rays meeting the truth that also meet the mesh."""
        return float(self.both.sum() / self.valid.sum())

    def only(self, where: Bool[Tensor, "height width"]) -> "Meeting":
        """Restrict ``both``: other rays count as misses of the mesh."""
        kept = where[self.both]
        normals = self.normals_true
        return self.replace(
            both=self.both & where,
            points=self.points[kept],
            points_true=self.points_true[kept],
            normals_true=None if normals is None else normals[kept],
        )

    def interpolate(
        self, per_vertex: Float[Tensor, "vertex channel"]
    ) -> Float[Tensor, "ray channel"]:
        """Interpolate vertex values of the mesh at the rays that meet both."""
        return self.hits.interpolate(per_vertex, self.faces)[self.both]


def meet_in_view(
    mesh: Mesh,
    cameras_true: Cameras,
    view: int,
    depth_true: Float[Tensor, "height width"],
    where: Bool[Tensor, "height width"] | None = None,
) -> Meeting:
    """Cast the rays of a true camera on a mesh.

    Args:
        mesh: Frame of the truth.
        depth_true: Along that camera's z; infinite off the truth.

    Raises:
        InputError: No pixel can be compared, or no ray meets the mesh.
    """
    valid = depth_true.isfinite() if where is None else depth_true.isfinite() & where
    hits = cast_view(mesh, cameras_true, view)
    both = valid & (hits.face >= 0)
    if not both.any():
        raise InputError(
            f"view {view}: {int(valid.sum())} pixels have a true depth, and "
            f"{int((hits.face >= 0).sum())} rays meet the mesh, none at those pixels. Check the "
            "frame of the mesh."
        )
    pixels = pixel_centers(both.shape[1], both.shape[0], like=cameras_true.intrinsics)[both]
    rays = rays_through(pixels, cameras_true.cam_from_world[view], cameras_true.intrinsics[view])
    return Meeting(
        valid=valid,
        both=both,
        points=hits.distance[both][:, None].to(rays) * rays,
        points_true=depth_true[both][:, None].to(rays) * rays,
        center_world=cameras_true.centers_world[view],
        hits=hits,
        faces=mesh.faces,
    )


def without_surroundings(met: Meeting, truth: Truth) -> Meeting:
    """Count rays that meet the mesh on the surroundings behind the object as misses.

    If a surface has a hole in the object and continues over the table, a ray through the hole meets
    the table. This is a missing part, not an error of the object's shape. Such a point is behind
    the true one on its ray, and nearer to the true surroundings than to the true object.
    """
    if truth.mesh is None or truth.surroundings is None or not len(truth.surroundings.faces):
        return met
    distance = (met.points - met.points_true).norm(dim=1)
    candidates = (met.points.norm(dim=1) > met.points_true.norm(dim=1)).nonzero()[:, 0]
    points = met.center_world.to(met.points) + met.points[candidates]
    aside = NearestSurface(truth.surroundings).query(points).distance
    # The object is no farther than its point on the ray, so most candidates need no query.
    undecided = aside < distance[candidates]
    candidates, points, aside = candidates[undecided], points[undecided], aside[undecided]
    on_surroundings = torch.zeros(len(distance), dtype=torch.bool, device=distance.device)
    on_surroundings[candidates] = aside < NearestSurface(truth.mesh).query(points).distance
    kept = met.both.clone()
    kept[met.both] = ~on_surroundings
    return met.only(kept)


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleFigures(Record):
    """Angles between normals over the rays that meet both, and :func:`pitted_percent`."""

    mean_deg: float
    median_deg: float
    pitted_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewFigures(Record):
    """Errors of a mesh along the rays of one true camera.

    Attributes:
        coverage: Fraction of the true pixels with a ray that meets the mesh, excluding its
            surroundings; the other figures are over these pixels.
        transferred_normals: Of the stored vertex normals; ``None`` without these, or if
            the true ones are unknown.
        shape_normals: Of the normals of its shape: area-weighted vertex normals, interpolated.
        albedo: ``None`` if either side has none.
    """

    name: str
    relative_error: float
    coverage: float
    pixels: int
    transferred_normals: AngleFigures | None
    shape_normals: AngleFigures | None
    albedo: AlbedoFigures | None


def compare_along_rays(mesh: Mesh, capture: Capture, view: int) -> ViewFigures | None:
    """Compare a mesh with the truth, in the frame of the truth, over :func:`meet_truth`'s rays."""
    met = meet_truth(mesh, capture, view)
    return None if met is None else figures_of(met, mesh, capture, view)


def meet_truth(mesh: Mesh, capture: Capture, view: int) -> Meeting | None:
    """Cast the rays of a true view on a mesh in the frame of the truth.

    The truth's depth map is used, or rays are cast on its mesh. Only the object is compared if
    it is known: the truth's foreground, else the masks of the photographs. Rays that pass the
    object and meet the mesh on the truth's surroundings are misses.

    Returns:
        ``None`` if the truth has neither depth maps nor a mesh, or no cameras.
    """
    cameras, maps = capture.cameras, _true_maps(capture, view)
    if cameras is None or maps is None or len(mesh.faces) == 0:
        return None
    depth, normals, where = maps
    met = meet_in_view(mesh, cameras, view, depth, where)
    met = met.replace(normals_true=None if normals is None else normals[met.both])
    met = without_surroundings(met, capture.truth)
    if not met.both.any():
        raise InputError(
            f"view {capture.views.names[view]}: rays through the object meet the mesh only on the "
            "surroundings. Check that the mesh contains the object."
        )
    return met


def figures_of(met: Meeting, mesh: Mesh, capture: Capture, view: int) -> ViewFigures:
    """Compare a mesh with the truth over the rays of ``met`` that meet both, at least one."""
    albedo = None
    if mesh.albedo is not None and capture.truth.albedo is not None:
        albedo = compare_albedo(met.interpolate(mesh.albedo), capture.truth.albedo[view][met.both])
    shape = vertex_normals(mesh.vertices_world, mesh.faces)
    return ViewFigures(
        name=capture.views.names[view],
        relative_error=float(relative_error(met.points.double(), met.points_true.double())),
        coverage=met.coverage,
        pixels=int(met.valid.sum()),
        transferred_normals=_angles(met, mesh.normals_world),
        shape_normals=_angles(met, shape),
        albedo=albedo,
    )


_Maps = tuple[
    Float[Tensor, "height width"],
    Float[Tensor, "height width 3"] | None,
    Bool[Tensor, "height width"] | None,
]
"""Depth (infinite where unknown), normals (zero where unknown) and object of a view."""


def _true_maps(capture: Capture, view: int) -> _Maps | None:
    """Return the truth's maps, or render them from its mesh."""
    truth, cameras = capture.truth, capture.cameras
    if truth.depth is not None:
        masks = capture.views.masks if truth.foreground is None else truth.foreground
        normals = None if truth.normals_world is None else truth.normals_world[view]
        return truth.depth[view], normals, None if masks is None else masks[view]
    if truth.mesh is None or len(truth.mesh.faces) == 0 or cameras is None:
        return None
    joined = with_surroundings(truth.mesh, truth)
    hits = cast_view(joined, cameras, view)
    normals = hits.interpolate(vertex_normals(joined.vertices_world, joined.faces), joined.faces)
    return hits.distance, normals, (hits.face >= 0) & (hits.face < len(truth.mesh.faces))


def _angles(met: Meeting, normals: Float[Tensor, "vertex 3"] | None) -> AngleFigures | None:
    if normals is None or met.normals_true is None:
        return None
    ours, truth = met.interpolate(normals).double(), met.normals_true.double()
    valid = (truth.norm(dim=1) > 0) & (ours.norm(dim=1) > 0)
    if not bool(valid.any()):
        return None
    angles = angles_deg(normalize(ours[valid], dim=1), normalize(truth[valid], dim=1))
    where = met.both.clone()
    where[met.both] = valid
    error = torch.zeros(where.shape, dtype=angles.dtype, device=angles.device)
    error[where] = angles
    return AngleFigures(
        mean_deg=float(angles.mean()),
        median_deg=float(angles.median()),
        pitted_percent=pitted_percent(error, where),
    )
