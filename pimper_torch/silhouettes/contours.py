"""Constraints of the silhouettes on the surface, as one record that stages hand on."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import caution
from pimper_torch.geometry.projection import triangulate_rays
from pimper_torch.ledger import leave_out
from pimper_torch.records import Cameras, ContourPoints, ContourRays, Record, Silhouettes
from pimper_torch.silhouettes.hull import Everywhere, Hull, visual_hull
from pimper_torch.silhouettes.rays import RayConfig, contour_rays
from pimper_torch.silhouettes.tangency import contour_points
from pimper_torch.stage import Stage

# Fraction of the views whose silhouette may be wrong at a place. Those that are found lack parts in
# shadow: with 0.05, where 4 of 24 silhouettes of a cow lack a third of it, 23 % of its pixels are
# not covered, with 0.1 0.3 %. With 0.15 one of 8 views is outvoted: Chamfer 0.19 for 0.12.
_DISAGREEING = {"masks": 0.03, "found": 0.1}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Contours(Record):
    """Rays that the surface is tangent to, and the hull that it lies in.

    Attributes:
        rays: Through the silhouettes of all reliable views.
    """

    silhouettes: Silhouettes
    rays: ContourRays
    cameras: Cameras
    hull: Hull

    @classmethod
    def none(cls, silhouettes: Silhouettes, cameras: Cameras) -> "Contours":
        """Return contours without rays; the hull holds everything, or what is above planes."""
        like = cameras.cam_from_world
        rays = ContourRays(
            view=torch.zeros(0, dtype=torch.long, device=like.device),
            pixels=like.new_zeros(0, 2),
            rays_world=like.new_zeros(0, 3),
            normals_world=like.new_zeros(0, 3),
            sigma_px=like.new_zeros(0),
        )
        hull = Everywhere.of(cameras)
        for plane in silhouettes.planes_world:
            hull = hull.above(plane[:3], -plane[3])
        return cls(silhouettes=silhouettes, rays=rays, cameras=cameras, hull=hull)

    @property
    def confine(self) -> bool:
        """Whether the object lies in a hull that silhouettes tell."""
        return not isinstance(self.hull, Everywhere)

    def touching(
        self, points_world: Float[Tensor, "point 3"], normals_world: Float[Tensor, "point 3"]
    ) -> ContourPoints:
        """Find where the rays touch a surface; see :func:`.contour_points`."""
        if not self.confine:
            rays, none = self.rays, points_world.new_zeros(0)
            return ContourPoints(
                points_world=none.reshape(0, 3),
                normals_world=none.reshape(0, 3),
                variance=none,
                view=rays.view,
                ray=rays.view,
            )
        return contour_points(self.rays, self.cameras, self.hull, points_world, normals_world)


class TraceContours(Stage):
    """Turn silhouettes into constraints on the surface; a constant to autograd."""

    def __init__(self, config: RayConfig | None = None) -> None:
        super().__init__()
        self.config = config or RayConfig()

    @torch.no_grad()
    def forward(self, silhouettes: Silhouettes, cameras: Cameras) -> Contours:
        """Cast rays through the silhouettes and build their visual hull.

        Returns:
            Contours that constrain nothing where silhouettes leave nothing out, and, with a
            warning, where they have no place in common.
        """
        if silhouettes.source == "everything":
            return Contours.none(silhouettes, cameras)
        box = box_round(silhouettes, cameras)
        hull = None
        if box is not None:  # voxels need no more than single precision
            fraction = _DISAGREEING[silhouettes.source]
            hull = visual_hull(
                silhouettes, cameras.to(torch.float32), box.float(), disagreeing=fraction
            )
        leave_out("contours.hull", hull is None)
        if hull is None:
            caution(
                "contours: the silhouettes of the views have no place in common, so that they "
                "say nothing about the surface. Look at the masks: do they show the same "
                "object in all photographs?",
                stacklevel=2,
            )
            return Contours.none(silhouettes, cameras)
        rays = contour_rays(silhouettes, cameras, self.config)
        return Contours(silhouettes=silhouettes, rays=rays, cameras=cameras, hull=hull)


def box_round(silhouettes: Silhouettes, cameras: Cameras) -> Float[Tensor, "2 3"] | None:
    """Return the corners of a box that holds what the silhouettes show.

    Its centre is nearest to the rays through the centres of the silhouettes' bounding boxes; from
    there it reaches as far as the largest of them, seen from its camera, and half as far again:
    a silhouette may be cut by the photograph's border.

    Returns:
        ``None`` where fewer than two reliable views show anything.
    """
    masks = silhouettes.masks
    views = (silhouettes.reliable & masks.flatten(1).any(dim=1)).nonzero()[:, 0].tolist()
    if len(views) < 2:
        return None
    chosen, boxes = cameras.take(views), []
    for view in views:
        rows, columns = (masks[view].any(dim=1 - axis).nonzero() for axis in (0, 1))
        low = torch.stack([columns.amin(), rows.amin()])
        boxes.append(torch.stack([low, torch.stack([columns.amax(), rows.amax()]) + 1]))
    low, high = torch.stack(boxes).to(chosen.intrinsics).unbind(dim=1)
    seen = torch.ones(1, len(views), dtype=torch.bool, device=low.device)
    centre = triangulate_rays(chosen, (low + high)[None] / 2, seen)[0]
    distance = (centre - chosen.centers_world).norm(dim=1)
    half = (high - low).norm(dim=1) / 2 / chosen.intrinsics[:, 0, 0]
    reach = 1.5 * (distance * half).amax()
    return torch.stack([centre - reach, centre + reach])
