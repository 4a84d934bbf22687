"""What the outlines say about the surface, as one record that stages hand on."""

import warnings
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import PimperWarning
from pimper_torch.geometry.projection import triangulate_rays
from pimper_torch.outlines.hull import Everywhere, Hull, visual_hull
from pimper_torch.records import Cameras, Outlines, Record, RimPoints, RimRays
from pimper_torch.rims.contours import RimConfig, rim_rays
from pimper_torch.rims.touching import rim_points
from pimper_torch.stage import Stage

# Share of the views whose outline may be wrong at a place: as large for outlines that are found as
# in the vote that finds them. In one of 24 photographs of a skull, shadow took the end of the jaw.
_DISAGREEING = {"masks": 0.03, "found": 0.05}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rims(Record):
    """Rays that the surface is tangent to, and the hull that it lies in.

    Attributes:
        outlines: Of all views.
        rays: Through the outlines of all trusted views.
        cameras: Of all views.
        hull: The visual hull of the same outlines.
    """

    outlines: Outlines
    rays: RimRays
    cameras: Cameras
    hull: Hull

    @classmethod
    def none(cls, outlines: Outlines, cameras: Cameras) -> "Rims":
        """Give rims that constrain nothing: no rays, and a hull that holds everything."""
        like = cameras.cam_from_world
        rays = RimRays(
            view=torch.zeros(0, dtype=torch.long, device=like.device),
            pixels=like.new_zeros(0, 2),
            rays_world=like.new_zeros(0, 3),
            normals_world=like.new_zeros(0, 3),
            sigma_px=like.new_zeros(0),
        )
        return cls(outlines=outlines, rays=rays, cameras=cameras, hull=Everywhere.of(cameras))

    @property
    def confine(self) -> bool:
        """Whether the object lies in a hull that outlines tell."""
        return not isinstance(self.hull, Everywhere)

    def touching(
        self, points_world: Float[Tensor, "point 3"], normals_world: Float[Tensor, "point 3"]
    ) -> RimPoints:
        """Find where the rays touch a surface; see :func:`~pimper_torch.rims.touching.rim_points`.

        Args:
            points_world: Of the surface: a cloud or a mesh's vertices.
            normals_world: Theirs, unit, outward.
        """
        if not self.confine:
            rays, none = self.rays, points_world.new_zeros(0)
            return RimPoints(
                points_world=none.reshape(0, 3),
                normals_world=none.reshape(0, 3),
                variance=none,
                view=rays.view,
                ray=rays.view,
            )
        return rim_points(self.rays, self.cameras, self.hull, points_world, normals_world)


class Rim(Stage):
    """Turn outlines into constraints on the surface; a constant to autograd."""

    def __init__(self, config: RimConfig | None = None) -> None:
        super().__init__()
        self.config = config or RimConfig()

    @torch.no_grad()
    def forward(self, outlines: Outlines, cameras: Cameras) -> Rims:
        """Cast rays through the outlines and build their visual hull.

        Args:
            outlines: Of all views.
            cameras: Of the same views.

        Returns:
            Rims that constrain nothing where outlines leave nothing out, and, with a warning,
            where they have no place in common.
        """
        if outlines.source == "everything":
            return Rims.none(outlines, cameras)
        box = box_round(outlines, cameras)
        hull = None
        if box is not None:  # voxels need no more than single precision
            share = _DISAGREEING[outlines.source]
            hull = visual_hull(outlines, cameras.to(torch.float32), box.float(), disagreeing=share)
        if hull is None:
            warnings.warn(
                PimperWarning(
                    "rims: the outlines of the views have no place in common, so that they say "
                    "nothing about the surface. Look at the masks: do they show the same object "
                    "in all photographs?"
                ),
                stacklevel=2,
            )
            return Rims.none(outlines, cameras)
        rays = rim_rays(outlines, cameras, self.config)
        return Rims(outlines=outlines, rays=rays, cameras=cameras, hull=hull)


def box_round(outlines: Outlines, cameras: Cameras) -> Float[Tensor, "2 3"] | None:
    """Give the corners of a box that holds what the outlines show.

    Its middle is nearest to the rays through the middles of the outlines' bounding boxes; from
    there it reaches as far as the largest of them, seen from its camera, and half as far again:
    an outline may be cut by the photograph's border.

    Returns:
        ``None`` where fewer than two trusted views show anything.
    """
    masks = outlines.masks
    views = (outlines.trusted & masks.flatten(1).any(dim=1)).nonzero()[:, 0].tolist()
    if len(views) < 2:
        return None
    chosen, boxes = cameras.take(views), []
    for view in views:
        rows, columns = (masks[view].any(dim=1 - axis).nonzero() for axis in (0, 1))
        low = torch.stack([columns.amin(), rows.amin()])
        boxes.append(torch.stack([low, torch.stack([columns.amax(), rows.amax()]) + 1]))
    low, high = torch.stack(boxes).to(chosen.intrinsics).unbind(dim=1)
    seen = torch.ones(1, len(views), dtype=torch.bool, device=low.device)
    middle = triangulate_rays(chosen, (low + high)[None] / 2, seen)[0]
    distance = (middle - chosen.centers_world).norm(dim=1)
    half = (high - low).norm(dim=1) / 2 / chosen.intrinsics[:, 0, 0]
    reach = 1.5 * (distance * half).amax()
    return torch.stack([middle - reach, middle + reach])
