"""Guesses about photographs from elsewhere, such as learned ones, each with its variance.

Maps belong to photographs by name, cover the whole photograph at any resolution, and those of
unlike sizes are padded on the right and at the bottom. Variance is infinite where nothing is
guessed. Axes of a camera are x right, y down, z forward: what faces it has normal (0, 0, -1).
What is left open, or has other axes, :func:`~pimper_torch.priors.settled.settled` decides.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.value_checks import not_finite, not_unit, once, outside

Axes = Literal["opengl", "opencv", "lub"]
AXES: dict[Axes, tuple[tuple[int, int, int], str]] = {
    "opencv": ((1, 1, 1), "x right, y down, z into the scene"),
    "opengl": ((1, -1, -1), "x right, y up, z to the viewer"),
    "lub": ((-1, -1, -1), "x left, y up, z to the viewer"),
}
"""Signs that turn normals of a camera's axes to ours, and back; and where the axes point."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MapPrior(Record):
    """Guessed maps of some photographs.

    Attributes:
        sizes_px: Width and height of each map inside the raster.
        undistorted: Whether the maps are of the photographs that structure from motion has
            undistorted, or of the original ones.
    """

    names: tuple[str, ...]
    sizes_px: Int[Tensor, "map 2"]
    undistorted: bool = False

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List names that are not one a map."""
        if len(self.names) != len(self.sizes_px) or len(set(self.names)) < len(self.names):
            found = f"are {len(self.names)}, {len(set(self.names))} of them different"
            yield "names", found, f"a name of its own for each of {len(self.sizes_px)} maps"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NormalPrior(MapPrior):
    """Guessed normals.

    Attributes:
        normals: Unit, outward; anything where the variance is infinite.
        variance: Mean square of their angular error, squared radians.
        frame: Of the normals: each photograph's camera, or the scene's world.
        axes: Of the cameras; ``None`` leaves these and the frame open.
    """

    normals: Float[Tensor, "map height width 3"]
    variance: Float[Tensor, "map height width"]
    frame: Literal["camera", "world"] = "camera"
    axes: Axes | None = "opencv"

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List what is no normal, and what is no variance."""
        yield from super(NormalPrior, self).faults()
        normals, known = self.normals, self.variance.isfinite()
        if found := once(normals, lambda: not_unit(normals, known), id(self.variance)):
            yield "normals", found, "unit normals where the variance is finite"
        yield from _no_variance(self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthPrior(MapPrior):
    """Guessed depth.

    Attributes:
        depth: Of what each pixel shows, or one over it.
        variance: Squared units of ``depth``.
        along: Whether depth counts along the camera's axis, or along the pixel's ray.
        inverse: Whether ``depth`` is one over depth; ``None`` leaves this, ``along`` and ``gauge``
            open.
        gauge: Whether ``depth`` is in scene units, up to a factor each map, or up to a factor and
            an offset each map; both are fitted.
    """

    depth: Float[Tensor, "map height width"]
    variance: Float[Tensor, "map height width"]
    along: Literal["axis", "ray"] = "axis"
    inverse: bool | None = False
    gauge: Literal["scene", "scale", "affine"] = "affine"

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List depth that is nowhere, and what is no variance."""
        yield from super(DepthPrior, self).faults()
        depth, known = self.depth, self.variance.isfinite()
        if found := once(depth, lambda: not_finite(depth, known), id(self.variance)):
            yield "depth", found, "finite where the variance is"
        yield from _no_variance(self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class AlbedoPrior(MapPrior):
    """Guessed albedo.

    Attributes:
        albedo: Linear, up to one factor a map, which is fitted.
        variance: Squared units of ``albedo``.
    """

    albedo: Float[Tensor, "map channel height width"]
    variance: Float[Tensor, "map height width"]

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List what is no variance."""
        yield from super(AlbedoPrior, self).faults()
        yield from _no_variance(self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class InlierPrior(MapPrior):
    """Guessed probability that a pixel shows diffuse reflection of the light of its photograph.

    Shadow, highlight and interreflection do not. Its variance is that of a coin: p (1 - p).

    Attributes:
        probability: In [0, 1].
    """

    probability: Float[Tensor, "map height width"]

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List what is no probability."""
        yield from super(InlierPrior, self).faults()
        probability = self.probability
        if found := once(probability, lambda: outside(probability, 1.0)):
            yield "probability", found, "probabilities"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SilhouettePrior(MapPrior):
    """Guessed silhouettes of the object. Its variance is that of a coin: p (1 - p).

    Attributes:
        inside: Probability that a pixel shows the object, in [0, 1].
    """

    inside: Float[Tensor, "map height width"]

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List what is no probability."""
        yield from super(SilhouettePrior, self).faults()
        inside = self.inside
        if found := once(inside, lambda: outside(inside, 1.0)):
            yield "inside", found, "probabilities"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LightPrior(Record):
    """Guessed light of some photographs.

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

    def faults(self) -> Iterator[tuple[str, str, str]]:
        """List lights that are none, and what is no variance."""
        if len(self.names) != len(self.lights) or len(set(self.names)) < len(self.names):
            found = f"are {len(self.names)}, {len(set(self.names))} of them different"
            yield "names", found, f"a name of its own for each of {len(self.lights)} lights"
        lights = self.lights
        if found := once(lights, lambda: not_finite(lights)):
            yield "lights", found, "finite"
        yield from _no_variance(self.variance)


Prior = NormalPrior | DepthPrior | AlbedoPrior | InlierPrior | SilhouettePrior | LightPrior
"""Kinds of guesses that views carry in ``priors``."""


def _no_variance(variance: Float[Tensor, "..."]) -> Iterator[tuple[str, str, str]]:
    if found := once(variance, lambda: _not_above_zero(variance)):
        yield "variance", found, "above 0, infinite where nothing is guessed"


def _not_above_zero(variance: Float[Tensor, "..."]) -> str:
    count = int((~(variance > 0)).sum())
    return f"has {count} of {variance.numel()} values that are not above 0" if count else ""
