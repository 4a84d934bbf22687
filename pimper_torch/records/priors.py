"""External estimates for photographs, such as a network's, each with its variance.

Maps are matched to photographs by name and cover the complete photograph at any resolution. Maps of
different sizes are padded on the right and at the bottom. Variance is infinite without an estimate.
Camera axes are x right, y down, z forward: a surface facing the camera has normal (0, 0, -1).
:func:`~pimper_torch.priors.conventions.resolve_prior_conventions` finds axes that are not given.
"""

from dataclasses import dataclass, fields
from typing import Literal

from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.value_checks import (
    Faults,
    faults_in,
    faults_of_names,
    not_above_zero,
    not_finite,
    not_unit,
    outside,
)

Axes = Literal["opengl", "opencv", "lub"]
AXES: dict[Axes, tuple[tuple[int, int, int], str]] = {
    "opencv": ((1, 1, 1), "x right, y down, z into the scene"),
    "opengl": ((1, -1, -1), "x right, y up, z to the viewer"),
    "lub": ((-1, -1, -1), "x left, y up, z to the viewer"),
}
"""Signs that convert normals between a camera's axes and ours, and a description of the axes."""

_VARIANCE = "above 0, infinite without an estimate"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MapPrior(Record):
    """Estimated maps of some photographs.

    Attributes:
        sizes_px: Width and height of each map inside the raster.
        undistorted: True if the maps are of the photographs that structure from motion has
            undistorted, false for the original photographs.
    """

    names: tuple[str, ...]
    sizes_px: Int[Tensor, "map 2"]
    undistorted: bool = False

    def faults(self) -> Faults:
        """List invalid names, variances and probabilities."""
        yield from faults_of_names(self.names, len(self.sizes_px), "maps")
        for name in {"probability", "inside"} & {field.name for field in fields(self)}:
            yield from faults_in(name, "probabilities", outside, getattr(self, name), 1.0)
        variance = getattr(self, "variance", None)
        if variance is not None:  # that of probabilities follows from them
            yield from faults_in("variance", _VARIANCE, not_above_zero, variance)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NormalPrior(MapPrior):
    """Estimated normals.

    Attributes:
        normals: Unit, outward; arbitrary where the variance is infinite.
        variance: Mean square of their angular error, squared radians.
        frame: Of the normals: each photograph's camera, or the scene's world.
        axes: Of the cameras; ``None`` if unknown, as is then the frame.
    """

    normals: Float[Tensor, "map height width 3"]
    variance: Float[Tensor, "map height width"]
    frame: Literal["camera", "world"] = "camera"
    axes: Axes | None = "opencv"

    def faults(self) -> Faults:
        """List invalid names, variances and normals."""
        yield from super(NormalPrior, self).faults()
        needed = "unit normals where the variance is finite"
        yield from faults_in("normals", needed, _not_unit, self.normals, self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthPrior(MapPrior):
    """Estimated depth.

    Attributes:
        depth: Depth of every pixel, or its inverse.
        variance: Squared units of ``depth``.
        along: Whether depth is measured along the camera's axis or along the pixel's ray.
        inverse: Whether ``depth`` is inverse depth; ``None`` if unknown, as are then ``along`` and
            ``gauge``.
        gauge: Whether ``depth`` is in scene units, up to a factor per map, or up to a factor and
            an offset per map; both are fitted.
    """

    depth: Float[Tensor, "map height width"]
    variance: Float[Tensor, "map height width"]
    along: Literal["axis", "ray"] = "axis"
    inverse: bool | None = False
    gauge: Literal["scene", "scale", "affine"] = "affine"

    def faults(self) -> Faults:
        """List invalid names, variances and depths."""
        yield from super(DepthPrior, self).faults()
        needed = "finite where the variance is"
        yield from faults_in("depth", needed, _not_finite, self.depth, self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class AlbedoPrior(MapPrior):
    """Estimated albedo.

    Attributes:
        albedo: Linear, up to one factor per map, which is fitted.
        variance: Squared units of ``albedo``.
    """

    albedo: Float[Tensor, "map channel height width"]
    variance: Float[Tensor, "map height width"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class InlierPrior(MapPrior):
    """Estimated probability that a pixel shows diffuse reflection of its photograph's light.

    Shadow, highlight and interreflection do not. Its variance is Bernoulli's: p (1 - p).

    Attributes:
        probability: In [0, 1].
    """

    probability: Float[Tensor, "map height width"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SilhouettePrior(MapPrior):
    """Estimated silhouettes of the object. The variance is Bernoulli's: p (1 - p).

    Attributes:
        inside: Probability that a pixel shows the object, in [0, 1].
    """

    inside: Float[Tensor, "map height width"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LightPrior(Record):
    """Estimated light of some photographs.

    Attributes:
        lights: First-order harmonics ``l``, radiance = albedo * l . (1, n), up to one factor that
            all photographs share, which is fitted.
        variance: Mean square error over the square of the length of ``l``.
        frame: Of the harmonics: each photograph's camera, or the scene's world.
    """

    lights: Float[Tensor, "light 4"]
    variance: Float[Tensor, " light"]
    names: tuple[str, ...]
    frame: Literal["camera", "world"] = "camera"

    def faults(self) -> Faults:
        """List invalid names, lights and variances."""
        yield from faults_of_names(self.names, len(self.lights), "lights")
        yield from faults_in("lights", "finite", not_finite, self.lights)
        yield from faults_in("variance", _VARIANCE, not_above_zero, self.variance)


Prior = NormalPrior | DepthPrior | AlbedoPrior | InlierPrior | SilhouettePrior | LightPrior
"""Kinds of estimates in ``Views.priors``."""


def _not_unit(normals: Tensor, variance: Tensor) -> str:
    return not_unit(normals, variance.isfinite())


def _not_finite(depth: Tensor, variance: Tensor) -> str:
    return not_finite(depth, variance.isfinite())
