"""The published papers' 3D error, ray by ray, with its coverage and the normals' error."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.geometry.frames import rotate, transform
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import cast_view
from pimper_torch.records import Cameras, Mesh, Record


def relative_error(
    points: Float[Tensor, "point 3"], points_true: Float[Tensor, "point 3"]
) -> Float[Tensor, ""]:
    r"""Give the error of points as a percentage of the true points' spread.

    .. math:: 100 \lVert S - \hat S \rVert_F / \lVert S - \bar S \rVert_F

    Translating both sets, or scaling them, changes nothing. Differentiable where the points
    differ from the true ones.

    >>> square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    >>> relative_error(square + torch.tensor([0.0, 0, 0.1]), square)
    tensor(7.0711)
    """
    spread = (points_true - points_true.mean(dim=0)).norm()
    return 100 * (points - points_true).norm() / spread


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewComparison(Record):
    """How a mesh compares with the truth along the rays of one view.

    Attributes:
        relative_error: :func:`relative_error` over the rays that meet both, in per cent.
        coverage: Share of the true pixels whose ray meets the mesh.
        mean_angle_deg: Between the normals, over the same rays; NaN without true normals.
        median_angle_deg: The same.
        num_pixels: Rays that meet the truth.
    """

    relative_error: float
    coverage: float
    mean_angle_deg: float
    median_angle_deg: float
    num_pixels: int


def compare_in_view(
    mesh: Mesh,
    truth_from_world: Float[Tensor, "4 4"],
    cameras_true: Cameras,
    view: int,
    depth_true: Float[Tensor, "height width"],
    *,
    normals_true: Float[Tensor, "height width 3"] | None = None,
    where: Bool[Tensor, "height width"] | None = None,
) -> ViewComparison:
    """Compare a mesh with true depth along the rays of one true camera.

    A point and its estimate are where the same ray first meets the truth and the mesh,
    after the mesh was put in the frame of the truth. Rays that miss the mesh count against
    the coverage, not the error; state both.

    Args:
        mesh: The result. Its own vertex normals are compared if it has some.
        truth_from_world: Similarity; see :mod:`pimper_torch.metrics.similarity`.
        cameras_true: World frame and scene units of the truth.
        view: One of them.
        depth_true: Along that camera's z; infinite where there is nothing.
        normals_true: Unit, outward, frame of the truth.
        where: Restricts the comparison, to the object without its table for instance.

    Raises:
        InputError: No pixel is left to compare, or no ray meets the mesh.
    """
    valid = depth_true.isfinite() if where is None else depth_true.isfinite() & where
    moved = mesh.replace(
        vertices_world=transform(truth_from_world.to(mesh.vertices_world), mesh.vertices_world)
    )
    hits = cast_view(moved, cameras_true, view)
    both = valid & (hits.face >= 0)
    if not both.any():
        raise InputError(
            f"view {view}: {int(valid.sum())} pixels have a true depth, and the mesh is met by "
            f"{int((hits.face >= 0).sum())} rays, none of them at those pixels. Check the frame "
            "of the mesh."
        )
    width, height = (int(side) for side in cameras_true.sizes_px[view])
    pixels = pixel_centers(width, height, like=cameras_true.intrinsics)[both]
    rays = rays_through(pixels, cameras_true.cam_from_world[view], cameras_true.intrinsics[view])
    points = hits.distance[both][:, None].to(rays) * rays
    points_true = depth_true[both][:, None].to(rays) * rays
    angles = torch.full((1,), torch.nan)
    if normals_true is not None:
        own = mesh.normals_world
        if own is None:
            own = vertex_normals(mesh.vertices_world, mesh.faces)
        turned = rotate(truth_from_world.to(own), own)
        normals = normalize(hits.interpolate(turned, mesh.faces)[both].double(), dim=-1)
        angles = angles_deg(normals, normals_true[both].double())
    return ViewComparison(
        relative_error=float(relative_error(points, points_true)),
        coverage=float(both.sum() / valid.sum()),
        mean_angle_deg=float(angles.mean()),
        median_angle_deg=float(angles.median()),
        num_pixels=int(valid.sum()),
    )


def angles_deg(
    normals: Float[Tensor, "*batch 3"], normals_true: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Give the angles between vectors, accurate also where they nearly agree."""
    sine = torch.linalg.cross(normals, normals_true).norm(dim=-1)
    cosine = (normals * normals_true).sum(dim=-1)
    return torch.rad2deg(torch.atan2(sine, cosine))
