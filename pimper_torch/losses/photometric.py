"""Error of the photographs that a surface predicts."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.losses.visible import Visible, in_view, interpolated_at, well_visible
from pimper_torch.records import SparseScene, Surface
from pimper_torch.records.shapes import Scalar
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.torch_settings import isolated

_UNKNOWNS = 4  # of the light of a photograph
_ROUNDS = 60  # of reweighting: with 12, gradients are off by up to 0.8 %


class PhotometricLoss(nn.Module):
    r"""Cauchy's loss of predicted photographs, over their contrast.

    A light of four numbers per photograph, ambient and directed, is fitted to the vertices that
    the photograph shows, and predicts their radiance from albedo and normal. The loss of a
    photograph is the mean of :math:`s^2 \log(1 + (e / s)^2)` over the vertices, with :math:`e` the
    error of the prediction over the standard deviation of the radiance: darker or flatter
    photographs gain nothing. Cast shadows and highlights, which are not predicted, are outliers.

    Differentiable in photographs, cameras and surface. The fitted light is a minimum of the same
    loss, so its own gradient is zero. Which vertices are visible is constant.

    Args:
        scale: :math:`s`, in units of the contrast.
        darkest: Least grey value; darker ones are in shadow.
        brightest: Largest grey value; larger ones are saturated.
    """

    def __init__(self, scale: float = 0.3, darkest: float = 0.02, brightest: float = 0.97) -> None:
        super().__init__()
        self.scale, self.darkest, self.brightest = scale, darkest, brightest

    @isolated
    @torch.no_grad()
    def visible(self, surface: Surface, scene: SparseScene) -> Visible:
        """Return the vertices that each photograph shows, neither dark nor saturated."""
        visible = well_visible(surface, scene.cameras)
        gray = torch.stack([gray_at(surface, scene, view) for view in range(len(visible))])
        return visible & (gray > self.darkest) & (gray < self.brightest)

    @isolated
    def forward(
        self, surface: Surface, scene: SparseScene, visible: Visible | None = None
    ) -> Scalar:
        """Return the mean loss of the photographs of a scene: a step's, or the held-out ones.

        Args:
            visible: By :meth:`visible`, for example of the first step; by default of this surface.

        Raises:
            InputError: No photograph shows more vertices than its light has unknowns.
        """
        visible = self.visible(surface, scene) if visible is None else visible
        if visible.shape[1] != len(surface.vertices_world):
            raise InputError(
                f"visible: of {visible.shape[1]} vertices; needed: of the surface's "
                f"{len(surface.vertices_world)}. A chain keeps them with `fuse.max_lost` 0."
            )
        views = (visible.sum(dim=1) > _UNKNOWNS).nonzero()[:, 0].tolist()
        if not views:
            raise InputError(
                f"surface: no photograph shows more than {_UNKNOWNS} of its vertices; needed: one "
                "at least. The cameras may not belong to it, or the photographs may be too dark."
            )
        errors = self.errors(surface, scene, visible, views)
        losses = [(error / self.scale).square().log1p().mean() for error in errors]
        return self.scale**2 * torch.stack(losses).mean()

    def errors(
        self,
        surface: Surface,
        scene: SparseScene,
        visible: Visible,
        views: Sequence[int] | None = None,
    ) -> list[Float[Tensor, " visible"]]:
        """Return the errors of photographs, all by default, at visible vertices over contrast."""
        basis = harmonics(surface.normals_world) * surface.albedo.mean(dim=1, keepdim=True)
        found = []
        for view in range(len(visible)) if views is None else views:
            shown = visible[view]
            radiance, known = gray_at(surface, scene, view)[shown], basis[shown]
            contrast = radiance.std()
            found.append((radiance - known @ self._light(known, radiance, contrast)) / contrast)
        return found

    @torch.no_grad()
    def _light(self, basis: Tensor, radiance: Tensor, contrast: Tensor) -> Tensor:
        """Return the light with the least loss, by reweighted least squares."""
        light, weight = basis.new_zeros(basis.shape[1]), torch.ones_like(radiance)
        for _ in range(_ROUNDS):
            weighted = (weight[:, None] * basis).mT
            light = torch.linalg.pinv(weighted @ basis) @ (weighted @ radiance)
            weight = 1 / (1 + ((radiance - basis @ light) / contrast / self.scale).square())
        return light


def gray_at(surface: Surface, scene: SparseScene, view: int) -> Float[Tensor, " vertex"]:
    """Return the mean of the channels of a photograph at all vertices."""
    pixels, _ = in_view(surface.vertices_world, scene.cameras, view)
    return interpolated_at(scene.views.images[view], pixels).mean(dim=1).to(pixels)
