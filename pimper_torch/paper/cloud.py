"""Which facets the points of the cloud lie on."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.coarse.covariances import point_covariances
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import barycentric_2d
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, SparseScene

# Pairs of points and facets that are tested at once; bounds memory to some 100 MB.
_TESTS_AT_ONCE = 2_000_000


def with_cloud(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    mesh: Mesh,
    reference: int,
    source: Int[Tensor, " vertex"],
) -> CoarseMesh:
    """Make a coarse mesh of facets and the points of the cloud on them, with covariances.

    Args:
        reference: The view they were triangulated in.
        source: The point of the cloud at each vertex, -1 for none.
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


def facets_under(
    pixels: Float[Tensor, "point 2"], corners_px: Float[Tensor, "face 3 2"]
) -> Int[Tensor, " point"]:
    """Find the facet that contains each point of an image, -1 outside all.

    Args:
        corners_px: Of facets that do not overlap in the image.
    """
    found = []
    for some in torch.split(pixels, max(1, _TESTS_AT_ONCE // max(1, len(corners_px)))):
        within = (barycentric_2d(some[:, None], corners_px[None]) >= 0).all(dim=-1)
        facet = within.to(torch.int8).argmax(dim=1)
        found.append(torch.where(within.any(dim=1), facet, -1))
    return torch.cat(found)
