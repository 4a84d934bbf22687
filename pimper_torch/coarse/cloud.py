"""How well the points of the cloud are known, and which facets they lie on."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import barycentric_2d
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, SparseScene

# Degrees of freedom that the median over all points counts for next to a point's own
# residuals, of which a track of three views leaves three.
_COMMON_FREEDOM = 6.0

# Fraction of its mean information that a point is taken to have in every direction: a depth is
# at most 1,000 times less certain than a place across, as where only one view sees it.
_MIN_INFORMATION = 1e-6

# Tests of points against facets made at once; bounds memory.
_TESTS_AT_ONCE = 2_000_000


def with_cloud(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    mesh: Mesh,
    reference: int,
    source: Int[Tensor, " vertex"],
) -> CoarseMesh:
    """Put a mesh beside what is known of the cloud's points on it.

    Args:
        scene: The cloud.
        reliable: Its points that lie on the object.
        mesh: The facets.
        reference: The view they were triangulated in.
        source: The point that each vertex is, -1 for a vertex that is none.
    """
    is_point = source >= 0
    at_vertices = point_covariances(scene, source.clamp_min(0))
    between = reliable[~torch.isin(reliable, source)]
    camera = scene.cameras.cam_from_world[reference], scene.cameras.intrinsics[reference]
    pixels, _ = project(scene.points_world[between], *camera)
    corners, _ = project(mesh.vertices_world[mesh.faces], *camera)
    facet = facets_under(pixels, corners)
    between, facet = between[facet >= 0], facet[facet >= 0]
    return CoarseMesh(
        mesh=mesh,
        reference=reference,
        is_point=is_point,
        covariance_world=torch.where(is_point[:, None, None], at_vertices, 0),
        points=FacetPoints(
            points_world=scene.points_world[between],
            covariance_world=point_covariances(scene, between),
            facet=facet,
        ),
    )


def point_covariances(
    scene: SparseScene, index: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    r"""Give the covariance of points' places, as their rays leave it.

    .. math:: C = \sigma^2 \Big( \sum_{views} J^T J \Big)^{-1}

    with J the derivative of the pixel in the place: a point is uncertain along its rays, the
    more so the farther it is and the narrower the angle between them. The pixel's noise
    :math:`\sigma` is estimated from the point's mean reprojection error :math:`e` over n
    views, :math:`\sigma^2 = (2 e^2 / \pi) \, 2n / (2n - 3)` for Gaussian noise, blended with
    the median of the cloud, for a short track says little about its own noise. Cameras are
    taken as known.

    Args:
        scene: Cameras, cloud and tracks.
        index: Which points.

    Returns:
        Scene units squared.

    Source: Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 5.2, for the
    back-propagation of pixel noise.
    """
    cameras, point = scene.cameras, scene.observation_point
    view, count = scene.observation_view, len(scene.points_world)
    frames = cameras.cam_from_world[view].double()
    intrinsics = cameras.intrinsics[view].double()
    place = transform(frames, scene.points_world[point, None].double())
    depth = place[:, 0, 2, None, None]
    pixel = (place @ intrinsics.mT)[:, 0, :2, None] / depth
    inward = intrinsics.new_tensor([0, 0, 1])
    rate = (intrinsics[:, :2] - pixel * inward) / depth @ frames[:, :3, :3]
    information = rate.new_zeros(count, 3, 3).index_add(0, point, rate.mT @ rate)[index]
    least = _MIN_INFORMATION * information.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    eye = torch.eye(3, dtype=rate.dtype, device=rate.device)
    covariance = torch.linalg.inv(information + least[:, None, None] * eye)

    views = torch.bincount(point, minlength=count).double()
    freedom = (2 * views - 3).clamp_min(1)
    error = scene.reprojection_errors_px.double()
    noise = 2 / torch.pi * error.square() * 2 * views / freedom
    common = noise.median()
    blended = (_COMMON_FREEDOM * common + freedom * noise) / (_COMMON_FREEDOM + freedom)
    return (blended[index, None, None] * covariance).to(scene.points_world)


def facets_under(
    pixels: Float[Tensor, "point 2"], corners_px: Float[Tensor, "face 3 2"]
) -> Int[Tensor, " point"]:
    """Find the facet that each point of an image lies in, -1 outside all.

    Args:
        pixels: The points.
        corners_px: Of facets that do not overlap in the image.
    """
    found = []
    for some in torch.split(pixels, max(1, _TESTS_AT_ONCE // max(1, len(corners_px)))):
        within = (barycentric_2d(some[:, None], corners_px[None]) >= 0).all(dim=-1)
        facet = within.to(torch.int8).argmax(dim=1)
        found.append(torch.where(within.any(dim=1), facet, -1))
    return torch.cat(found)
