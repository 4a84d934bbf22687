"""What methods of photometric stereo are given, and what they give back."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.single_view.factorization.ambiguity import Ambiguity
from pimper_torch.single_view.factorization.bas_relief import BasRelief


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Problem(Record):
    """What methods are given: the pixels inside the mask, in raster order, in float64.

    Attributes:
        images: As they came, those views that have samples.
        radiance: Linear; zero where missing.
        weight: 0 where missing.
        mask: Where the pixels are.
        lights: If known.
        intrinsics: Of a camera near by; ``None`` for one far away.
        generator: On the CPU.
        robust: Whether shadows and highlights are to lose weight.
        ambient: Whether pixels have a radiance of their own.
    """

    images: Float[Tensor, "view channel height width"]
    radiance: Float[Tensor, "view channel pixel"]
    weight: Float[Tensor, "view pixel"]
    mask: Bool[Tensor, "height width"]
    lights: Float[Tensor, "view 3"] | None
    intrinsics: Float[Tensor, "3 3"] | None
    generator: torch.Generator
    robust: bool
    ambient: bool

    @property
    def gray(self) -> Float[Tensor, "view pixel"]:
        """The mean of the colours."""
        return self.radiance.mean(dim=1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Solution(Record):
    """What methods give back.

    Attributes:
        normals: Unit or zero.
        albedo: Of each colour.
        lights: Of the views that have samples.
        weight: What each sample was given in the end.
        applied: What was chosen of the transformations that the method leaves free.
        free: What is still free, in words.
    """

    normals: Float[Tensor, "3 pixel"]
    albedo: Float[Tensor, "channel pixel"]
    lights: Float[Tensor, "view unknown"]
    weight: Float[Tensor, "view pixel"]
    applied: BasRelief | Ambiguity | None
    free: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Surfaced(Record):
    """A factorization that is a surface's, up to a bas-relief transformation.

    Attributes:
        shading: Albedo times normal.
        lights: That go with it.
        reliability: Of each pixel; 0 leaves it out.
        weight: Of each sample.
    """

    shading: Float[Tensor, "3 pixel"]
    lights: Float[Tensor, "view 3"]
    reliability: Float[Tensor, " pixel"]
    weight: Float[Tensor, "view pixel"]
