"""The published papers' 3D error, ray by ray, with its coverage and the normals' error."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.errors import InputError
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visibility import Hits, cast_view
from pimper_torch.records import Cameras, Mesh, Record


def relative_error(
    points: Float[Tensor, "point 3"], points_true: Float[Tensor, "point 3"]
) -> Float[Tensor, ""]:
    r"""Return the error of points as a percentage of the true points' spread.

    .. math:: 100 \lVert S - \hat S \rVert_F / \lVert S - \bar S \rVert_F

    Translating both sets, or scaling them, changes nothing. Differentiable where the points
    differ from the true ones.

    >>> square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    >>> relative_error(square + torch.tensor([0.0, 0, 0.1]), square)
    tensor(7.0711)
    """
    spread = (points_true - points_true.mean(dim=0)).norm()
    return 100 * (points - points_true).norm() / spread


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Meeting(Record):
    """Where the rays of a view meet a mesh and the truth.

    Attributes:
        valid: True where a ray meets the truth.
        both: True where it meets the mesh too.
        points: Of the mesh, from the camera's centre, frame of the truth.
        center_world: Of the camera, frame of the truth.
    """

    valid: Bool[Tensor, "height width"]
    both: Bool[Tensor, "height width"]
    points: Float[Tensor, "ray 3"]
    points_true: Float[Tensor, "ray 3"]
    center_world: Float[Tensor, " 3"]
    hits: Hits
    faces: Int[Tensor, "face 3"]

    @property
    def coverage(self) -> float:
        """Fraction of the rays that meet the truth which meet the mesh too."""
        return float(self.both.sum() / self.valid.sum())

    @property
    def points_world(self) -> Float[Tensor, "ray 3"]:
        """Where the rays meet the mesh, frame of the truth."""
        return self.center_world.to(self.points) + self.points

    def only(self, where: Bool[Tensor, "height width"]) -> "Meeting":
        """Count all other rays as misses of the mesh."""
        kept = where[self.both]
        return self.replace(
            both=self.both & where, points=self.points[kept], points_true=self.points_true[kept]
        )

    def interpolate(
        self, per_vertex: Float[Tensor, "vertex channel"]
    ) -> Float[Tensor, "ray channel"]:
        """Blend values of the mesh's vertices where both are met."""
        return self.hits.interpolate(per_vertex, self.faces)[self.both]


def meet_in_view(
    mesh: Mesh,
    truth_from_world: Float[Tensor, "4 4"],
    cameras_true: Cameras,
    view: int,
    depth_true: Float[Tensor, "height width"],
    where: Bool[Tensor, "height width"] | None = None,
) -> Meeting:
    """Cast the rays of a true camera on a mesh put in the frame of the truth.

    Args:
        truth_from_world: Similarity.
        cameras_true: World frame and scene units of the truth.
        depth_true: Along that camera's z; infinite where there is nothing.

    Raises:
        InputError: No pixel is left to compare, or no ray meets the mesh.
    """
    valid = depth_true.isfinite() if where is None else depth_true.isfinite() & where
    moved = mesh.replace(
        vertices_world=transform(truth_from_world.to(mesh.vertices_world), mesh.vertices_world)
    )
    hits = cast_view(moved, cameras_true, view)
    height, width = hits.face.shape
    if depth_true.shape != (height, width):  # the views of a set share one raster, padded
        if depth_true.shape[0] < height or depth_true.shape[1] < width:
            raise InputError(
                f"view {view}: its true depth has {tuple(depth_true.shape)} rows and columns, its "
                f"camera {(height, width)}; needed: one and the same size."
            )
        hits = _padded(hits, depth_true.shape[0] - height, depth_true.shape[1] - width)
    both = valid & (hits.face >= 0)
    if not both.any():
        raise InputError(
            f"view {view}: {int(valid.sum())} pixels have a true depth, and the mesh is met by "
            f"{int((hits.face >= 0).sum())} rays, none of them at those pixels. Check the frame "
            "of the mesh."
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


def _padded(hits: Hits, rows: int, columns: int) -> Hits:
    """Add pixels that meet nothing, on the right and at the bottom."""
    return Hits(
        face=pad(hits.face, (0, columns, 0, rows), value=-1),
        distance=pad(hits.distance, (0, columns, 0, rows), value=torch.inf),
        barycentric=pad(hits.barycentric, (0, 0, 0, columns, 0, rows)),
    )


def angles_deg(
    normals: Float[Tensor, "*batch 3"], normals_true: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Return the angles between vectors, accurate also where they nearly agree."""
    sine = torch.linalg.cross(normals, normals_true).norm(dim=-1)
    cosine = (normals * normals_true).sum(dim=-1)
    return torch.rad2deg(torch.atan2(sine, cosine))
