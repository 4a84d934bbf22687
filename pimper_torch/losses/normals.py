"""Angle between a surface's normals and true ones in the photographs."""

import torch
from torch import nn

from pimper_torch.losses.visible import Visible, in_view, interpolated_at, well_visible
from pimper_torch.records import NormalPrior, SparseScene, Surface
from pimper_torch.records.shapes import Scalar
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.file_names import view_named
from pimper_torch.runtime.torch_settings import isolated


class NormalLoss(nn.Module):
    """Mean of one minus the cosine between normals of visible vertices and those of maps.

    Differentiable in the normals of both, in cameras and vertices; which vertices are visible is
    constant.

    Args:
        truth: In our camera axes, in undistorted photographs; unknown where the variance is
            infinite.
    """

    def __init__(self, truth: NormalPrior) -> None:
        super().__init__()
        if (truth.frame, truth.axes) != ("camera", "opencv"):
            raise InputError(
                f"truth: its normals are in {truth.frame} axes ({truth.axes}); needed: camera axes "
                "of OpenCV, as from `resolve_prior_conventions`."
            )
        self.truth = truth

    @isolated
    def forward(
        self, surface: Surface, scene: SparseScene, visible: Visible | None = None
    ) -> Scalar:
        """Return the mean over all photographs that have a map.

        Args:
            visible: By :func:`~pimper_torch.losses.visible.well_visible`, the default.

        Raises:
            InputError: A map belongs to no photograph, or no map has a visible normal.
        """
        cameras, losses = scene.cameras, []
        visible = well_visible(surface, cameras) if visible is None else visible
        for row, name in enumerate(self.truth.names):
            view = view_named(name, scene.views.names)
            (width, height), shown = self.truth.sizes_px[row].tolist(), visible[view]
            pixels, _ = in_view(surface.vertices_world[shown], cameras, view)
            pixels = pixels / cameras.sizes_px[view] * self.truth.sizes_px[row]
            known = self.truth.variance[row, :height, :width].isfinite()
            maps = torch.where(known[..., None], self.truth.normals[row, :height, :width], 0)
            true = interpolated_at(
                torch.cat([maps, known[..., None]], dim=-1).movedim(-1, 0), pixels
            )
            inside = true[:, 3] > 0.999  # no unknown pixel is near
            rotation = cameras.cam_from_world[view, :3, :3].to(true)
            normals = surface.normals_world[shown][inside].to(true) @ rotation.mT
            cosine = torch.cosine_similarity(normals, true[inside, :3], dim=1)
            losses.append(1 - cosine)
        every = torch.cat(losses)
        if not len(every):
            raise InputError("truth: no map has a normal where the surface is visible.")
        return every.mean()
