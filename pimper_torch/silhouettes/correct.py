"""Silhouettes cut again, seeded by the surface that was reconstructed from them.

The surface is what all views agree on; projected, it is nearer to the truth than the worst of the
silhouettes that it came from, and it knows nothing of their borders. Each view is cut again between
what both have inside and what both have outside.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.ledger import leave_out
from pimper_torch.records import Cameras, Mesh, Silhouettes, SparseScene
from pimper_torch.silhouettes.by_series import by_series
from pimper_torch.silhouettes.cues import cues_of
from pimper_torch.silhouettes.cuts import cut_from, cuts_of
from pimper_torch.silhouettes.opencv import signed_distance
from pimper_torch.silhouettes.pictures import of_views
from pimper_torch.silhouettes.probabilities import silhouettes_of
from pimper_torch.silhouettes.seeds import labels_from_surface
from pimper_torch.silhouettes.settings import SilhouetteConfig, SilhouetteDetails
from pimper_torch.stage import Stage

_STRIDE = 2  # working pixels between rays: seeds keep off the border by more


class CorrectSilhouettes(Stage):
    """Correct silhouettes by a surface that was reconstructed from them; constant to autograd."""

    def __init__(
        self, config: SilhouetteConfig | None = None, details: SilhouetteDetails | None = None
    ) -> None:
        super().__init__()
        self.config = config or SilhouetteConfig()
        self.details = details or SilhouetteDetails()

    @torch.no_grad()
    def forward(self, scene: SparseScene, silhouettes: Silhouettes, mesh: Mesh) -> Silhouettes:
        """Cut every view again.

        Args:
            scene: Photographs, cameras and cloud.
            silhouettes: That the surface was reconstructed from.
            mesh: The surface, in the scene's frame.

        Returns:
            Silhouettes that were found, corrected in the views whose new cut the surface confirms;
            masks that a person gave, and everything, as they are.
        """
        if silhouettes.source != "found":
            return silhouettes

        def of_some(part: SparseScene, views: tuple[int, ...]) -> Silhouettes:
            some = torch.tensor(views, device=silhouettes.inside.device)
            return self._corrected(
                part,
                silhouettes.replace(
                    inside=silhouettes.inside[some], reliable=silhouettes.reliable[some]
                ),
                mesh,
            )

        return by_series(scene, of_some)

    def _corrected(self, scene: SparseScene, silhouettes: Silhouettes, mesh: Mesh) -> Silhouettes:
        """Correct silhouettes of photographs between which the object was not moved."""
        cues = cues_of(scene, self.config, self.details)
        size = cues.pictures.grey.shape[1:]
        before = interpolate(silhouettes.inside.cpu()[:, None], size, mode="area")[:, 0] > 0.5
        seen = projections(mesh, cues.pictures.cameras, (size[1], size[0]))
        cues = cues.relearned(before | seen)

        def again(view: int) -> Bool[Tensor, "height width"]:
            agreement = None if cues.agreement is None else cues.agreement[view]
            return cut_from(
                cues.pictures.opponent[view],
                labels_from_surface(seen[view], before[view], agreement),
                before[view] | seen[view],
            )

        masks = of_views(again, cues.num_views)
        margins = of_views(lambda view: signed_distance(seen[view]), cues.num_views)
        cuts = cuts_of(cues, masks, margins)
        corrected = silhouettes_of(cuts, scene.views, self.details)
        confirmed = corrected.reliable
        leave_out("silhouettes.unconfirmed", ~confirmed, names=scene.views.names)
        return silhouettes.replace(
            inside=torch.where(confirmed[:, None, None], corrected.inside, silhouettes.inside),
            reliable=silhouettes.reliable | confirmed,
        )


def projections(
    mesh: Mesh, cameras: Cameras, size_px: tuple[int, int]
) -> Bool[Tensor, "view height width"]:
    """Mark the pixels of every view that show a mesh, by rays through every other pixel.

    Args:
        mesh: In the cameras' frame.
        cameras: Of the views.
        size_px: Width and height of the pictures.
    """
    width, height = size_px
    columns, rows = -(-width // _STRIDE), -(-height // _STRIDE)
    caster = RayCaster(mesh.vertices_world, mesh.faces)
    centres: Float[Tensor, "row column 2"] = pixel_centers(columns, rows, like=cameras.intrinsics)
    pixels = (centres * _STRIDE).reshape(-1, 2)

    def of_view(view: int) -> Bool[Tensor, "height width"]:
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        hit = caster.cast(cameras.centers_world[view], rays).face.reshape(rows, columns) >= 0
        finer = hit.repeat_interleave(_STRIDE, dim=0).repeat_interleave(_STRIDE, dim=1)
        return finer[:height, :width]

    return of_views(of_view, cameras.num_views)
