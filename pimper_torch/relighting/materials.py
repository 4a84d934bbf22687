"""Materials of a surface in glTF's terms, one for every cluster of albedo."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Materials(Record):
    """Materials for base colours of :func:`~pimper_torch.viz.maps.base_color`.

    Attributes:
        metallic: In [0, 1].
        roughness: In [0, 1]; its square is GGX's alpha.
        specular: Times what glTF's dielectric mirrors head on; ``KHR_materials_specular``'s
            ``specularFactor`` up to 1, ``specularColorFactor`` above.
    """

    cluster: Int[Tensor, " vertex"]
    metallic: Float[Tensor, " cluster"]
    roughness: Float[Tensor, " cluster"]
    specular: Float[Tensor, " cluster"]

    @classmethod
    def of(cls, cluster: Int[Tensor, " vertex"], values: Float[Tensor, "cluster 3"]) -> "Materials":
        """Return materials from metallic, roughness and specular of each cluster."""
        metallic, roughness, specular = values.unbind(dim=1)
        return cls(cluster=cluster, metallic=metallic, roughness=roughness, specular=specular)

    @property
    def values(self) -> Float[Tensor, "cluster 3"]:
        """Metallic, roughness and specular of every cluster."""
        return torch.stack([self.metallic, self.roughness, self.specular], dim=1)

    def at_vertices(self) -> Float[Tensor, "vertex 3"]:
        """Return metallic, roughness and specular of every vertex."""
        return self.values[self.cluster]
