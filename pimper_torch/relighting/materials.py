"""Metallic, roughness and specular of a surface, one of each for every cluster of albedo."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Materials(Record):
    """Materials in glTF's terms, for base colours of :func:`~pimper_torch.viz.maps.base_color`.

    Attributes:
        cluster: Of each vertex.
        metallic: In [0, 1].
        roughness: In [0, 1]; its square is GGX's alpha.
        specular: Times what glTF's dielectric mirrors head on; ``KHR_materials_specular``'s
            ``specularFactor`` up to 1, ``specularColorFactor`` above.
    """

    cluster: Int[Tensor, " vertex"]
    metallic: Float[Tensor, " cluster"]
    roughness: Float[Tensor, " cluster"]
    specular: Float[Tensor, " cluster"]

    def at_vertices(self) -> Float[Tensor, "vertex 3"]:
        """Return metallic, roughness and specular of every vertex."""
        return torch.stack([self.metallic, self.roughness, self.specular], dim=1)[self.cluster]


def matte(num_vertices: int) -> Materials:
    """Return one material without highlights."""
    return Materials(
        cluster=torch.zeros(num_vertices, dtype=torch.long),
        metallic=torch.zeros(1),
        roughness=torch.ones(1),
        specular=torch.zeros(1),
    )
