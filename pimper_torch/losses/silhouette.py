"""Distance between the outlines of a surface and of silhouettes."""

import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import nn

from pimper_torch.geometry.contours import contour_rays
from pimper_torch.losses.visible import in_view, interpolated_at
from pimper_torch.records import Cameras, Silhouettes, Surface
from pimper_torch.records.shapes import Scalar
from pimper_torch.runtime.errors import InputError


class SilhouetteLoss(nn.Module):
    """Mean distance in pixels of a surface from its silhouettes, both ways.

    The sum of the mean distance by which projected vertices are outside the silhouette, and the
    mean distance of points of the outline to the nearest projected vertex, which is about half the
    vertices' spacing for a perfect surface. Differentiable in vertices and cameras; the nearest
    vertex is constant. Unreliable silhouettes do not count.

    Args:
        silhouettes: Of the photographs of ``cameras``.
        cameras: For the outlines' positions; the loss takes its own.
        per_view: Points on the outline of each view.
    """

    def __init__(self, silhouettes: Silhouettes, cameras: Cameras, per_view: int = 300) -> None:
        super().__init__()
        if not bool(silhouettes.reliable.any()):
            raise InputError("silhouettes: none is reliable; needed: one at least.")
        self.outlines = contour_rays(silhouettes, cameras, per_view)
        self.views = [int(view) for view in silhouettes.reliable.nonzero()[:, 0]]
        self.outside_px = {
            view: torch.from_numpy(
                distance_transform_edt((silhouettes.inside[view] < 0.5).cpu().numpy())
            )
            for view in self.views
        }

    def forward(self, surface: Surface, cameras: Cameras) -> Scalar:
        """Return the mean over the reliable views."""
        losses = []
        for view in self.views:
            pixels, _ = in_view(surface.vertices_world, cameras, view)
            outside = interpolated_at(self.outside_px[view][None].to(pixels), pixels).mean()
            outline = self.outlines.pixels[self.outlines.view == view].to(pixels)
            _, nearest = cKDTree(pixels.detach().cpu().numpy()).query(outline.cpu().numpy())
            gap = (pixels[torch.from_numpy(nearest).to(pixels.device)] - outline).norm(dim=1)
            losses.append(outside + (gap.mean() if len(gap) else 0))
        return torch.stack(losses).mean()
