"""Disagreement of the photographs of a surface, whatever its albedo."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.losses.photometric import PhotometricLoss, gray_at
from pimper_torch.losses.visible import Visible
from pimper_torch.records import SparseScene, Surface

_ROUNDS = 10  # of the fit, which reweighs entries after each: a choice
_MIN_VIEWS = 4  # fewer photographs than the light has unknowns agree on any albedo: a choice


class ConsistencyLoss(PhotometricLoss):
    """As :class:`PhotometricLoss`, with the albedo at each vertex on which photographs agree.

    Photographs agree only if cameras and surface project a vertex to the same point of the object
    in all of them. The surface's albedo is an average, which hides small errors of cameras; here,
    ten rounds of least squares fit it together with the lights.

    Differentiable in photographs, cameras and surface, through these rounds. Which vertices are
    visible is constant.
    """

    def __init__(self, scale: float = 0.1, darkest: float = 0.02, brightest: float = 0.97) -> None:
        super().__init__(scale, darkest, brightest)

    @torch.no_grad()
    def visible(self, surface: Surface, scene: SparseScene) -> Visible:
        """Return the vertices that each photograph shows, if at least four show them."""
        visible = super().visible(surface, scene)
        return visible & (visible.sum(dim=0) >= _MIN_VIEWS)

    def errors(
        self,
        surface: Surface,
        scene: SparseScene,
        visible: Visible,
        views: Sequence[int] | None = None,
    ) -> list[Float[Tensor, " visible"]]:
        """Return the errors of photographs, all by default, at visible vertices over contrast."""
        basis, albedo = harmonics(surface.normals_world), surface.albedo.mean(dim=1)
        chosen = range(len(visible)) if views is None else views
        visible = visible[list(chosen)]
        gray = torch.stack([gray_at(surface, scene, view) for view in chosen])
        contrast = [row[shown].std() for row, shown in zip(gray, visible, strict=True)]
        gray = gray / torch.stack(contrast)[:, None]
        weight = visible.to(basis)
        error = gray
        for _ in range(_ROUNDS):
            known = albedo[:, None] * basis
            weighted = (weight[:, :, None] * known).mT
            lights = torch.linalg.pinv(weighted @ known) @ (weighted @ gray[:, :, None])
            shading = lights[..., 0] @ basis.mT
            total = (weight * shading.square()).sum(dim=0)
            seen = total > 0
            fitted = (weight * shading * gray).sum(dim=0) / torch.where(seen, total, 1)
            albedo = torch.where(seen, fitted, albedo)
            error = gray - albedo * shading
            weight = visible / (1 + (error / self.scale).square())
        return [row[shown] for row, shown in zip(error, visible, strict=True)]
