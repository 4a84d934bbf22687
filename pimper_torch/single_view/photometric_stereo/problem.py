"""Input and output of the methods of photometric stereo."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.single_view.factorization.bas_relief import BasRelief


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Problem(Record):
    """Input of a method: the pixels inside the mask, in raster order, in float64.

    Attributes:
        images: As given, those views that have samples.
        radiance: Linear; zero where missing.
        weight: 0 where missing.
        intrinsics: Of a perspective camera; ``None`` for an orthographic one.
    """

    images: Float[Tensor, "view channel height width"]
    radiance: Float[Tensor, "view channel pixel"]
    weight: Float[Tensor, "view pixel"]
    mask: Bool[Tensor, "height width"]
    lights: Float[Tensor, "view 3"] | None
    intrinsics: Float[Tensor, "3 3"] | None
    robust: bool

    @property
    def gray(self) -> Float[Tensor, "view pixel"]:
        """The mean of the colours."""
        return self.radiance.mean(dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Solution(Record):
    """Output of a method.

    Attributes:
        normals: Unit or zero.
        applied: The transformation that resolved the method's ambiguity, if any.
        free: The remaining ambiguity, in words.
    """

    normals: Float[Tensor, "3 pixel"]
    albedo: Float[Tensor, "channel pixel"]
    lights: Float[Tensor, "view 3"]
    weight: Float[Tensor, "view pixel"]
    applied: BasRelief | None
    free: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Surfaced(Record):
    """An integrable factorization, right up to a bas-relief transformation.

    Attributes:
        shading: Albedo times normal.
        reliability: Of each pixel; 0 leaves it out.
    """

    shading: Float[Tensor, "3 pixel"]
    lights: Float[Tensor, "view 3"]
    reliability: Float[Tensor, " pixel"]
    weight: Float[Tensor, "view pixel"]
