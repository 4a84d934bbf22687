"""Smooth random functions of space, and textures made from them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from pimper_bench.scenes.scene_object import Texture


@dataclass(frozen=True, slots=True, kw_only=True)
class Waves:
    """A sum of sines, smooth to every order."""

    wave_vectors: Float[Tensor, "wave axis"]
    phases: Float[Tensor, " wave"]
    amplitudes: Float[Tensor, " wave"]

    def __call__(self, points: Float[Tensor, "*batch axis"]) -> Float[Tensor, "*batch"]:
        """Return the values at points."""
        angle = points @ self.wave_vectors.to(points).mT + self.phases.to(points)
        return torch.sin(angle) @ self.amplitudes.to(points)


def random_waves(
    generator: torch.Generator,
    *,
    wavelength: float,
    root_mean_square: float,
    axes: int = 3,
    num_waves: int = 24,
) -> Waves:
    """Return random waves of similar wavelength in random directions.

    Args:
        wavelength: Scene units; drawn between 0.7 and 1.4 of this.
        axes: 3 in space, 2 over a plane.
        num_waves: More waves look more random and take longer.
    """
    direction = torch.randn(num_waves, axes, generator=generator, dtype=torch.float64)
    direction = direction / direction.norm(dim=1, keepdim=True)
    octave = torch.rand(num_waves, 1, generator=generator, dtype=torch.float64) - 0.5
    phases = 2 * torch.pi * torch.rand(num_waves, generator=generator, dtype=torch.float64)
    amplitude = root_mean_square * (2 / num_waves) ** 0.5
    return Waves(
        wave_vectors=direction * (2 * torch.pi / wavelength) * 2**octave,
        phases=phases,
        amplitudes=torch.full((num_waves,), amplitude, dtype=torch.float64),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Speckle:
    """A solid texture: an albedo for every point of space.

    Grids of random values, each finer than the previous one, are interpolated linearly, added and
    passed through a sigmoid, so that features of many sizes have edges.

    Attributes:
        subdivisions: One per octave, periodic: along each axis the last value repeats the first.
        cells: Scene units between grid points, one per octave.
        contrast: Steepness of the sigmoid.
        offset: Added before the sigmoid: far from 0, only rare spots are dark (or light).
    """

    subdivisions: Float[Tensor, "octave channel side side side"]
    cells: tuple[float, ...]
    weights: tuple[float, ...]
    darkest: float
    brightest: float
    contrast: float
    offset: float = 0.0
    tint: tuple[float, ...] = (1.0,)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the albedo at points."""
        rows = points.reshape(-1, 3)
        side = self.subdivisions.shape[-1] - 1
        channels = self.subdivisions.shape[1]
        total = rows.new_zeros(channels, len(rows))
        for subdivision, cell, weight in zip(
            self.subdivisions, self.cells, self.weights, strict=True
        ):
            grid = torch.remainder(rows / cell, side) * (2 / side) - 1
            values = grid_sample(
                subdivision[None].to(rows), grid[None, None, None], align_corners=True
            )
            total = total + weight * values[0, :, 0, 0]
        fraction = torch.sigmoid(self.contrast * (total + self.offset))
        albedo = self.darkest + (self.brightest - self.darkest) * fraction
        return (albedo.mT * rows.new_tensor(self.tint)).reshape(*points.shape[:-1], channels)


def random_speckle(
    generator: torch.Generator,
    *,
    cells: tuple[float, ...] = (0.41, 0.17, 0.071, 0.031, 0.014),
    darkest: float = 0.15,
    brightest: float = 0.85,
    contrast: float = 2.5,
    colour: float = 0.35,
    offset: float = 0.0,
    tint: tuple[float, ...] = (1.0,),
) -> Speckle:
    """Return a random texture.

    Args:
        cells: Sizes of its features in scene units.
        contrast: 0 is uniform; 2.5 gives many features to structure from motion.
        colour: 0 is gray; 1 makes the channels independent.
        offset: Positive for rare dark spots, negative for rare light ones.
        tint: Factor on the channels; one number, or one for each.
    """
    side = 64  # the period in cells; periods of the octaves differ
    shape = (len(cells), 1, side, side, side)
    shared = torch.randn(shape, generator=generator)
    rgb = torch.randn((len(cells), 3, side, side, side), generator=generator)
    return Speckle(
        subdivisions=pad((1 - colour) * shared + colour * rgb, (0, 1, 0, 1, 0, 1), mode="circular"),
        cells=cells,
        weights=tuple(1.0 for _ in cells),
        darkest=darkest,
        brightest=brightest,
        contrast=contrast,
        offset=offset,
        tint=tint,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Uniform:
    """A uniform albedo."""

    albedo: tuple[float, ...]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the albedo at points."""
        return points.new_tensor(self.albedo).expand(*points.shape[:-1], -1)


def painted(
    base: Texture,
    paint: Texture,
    *,
    radii: tuple[float, float],
    heights: tuple[float, float] = (-float("inf"), float("inf")),
    azimuths_deg: tuple[float, float] = (-180.0, 180.0),
) -> Texture:
    """Return a texture covered by a second one between two radii, heights and azimuths about z.

    Args:
        azimuths_deg: Counter-clockwise from -y, where the cameras are.
    """

    def albedo(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        x, y, height = points.unbind(dim=-1)
        radius = (x**2 + y**2).sqrt()
        azimuth = torch.rad2deg(torch.atan2(x, -y))
        inside = torch.ones_like(height, dtype=torch.bool)
        bounds = (radius, radii), (height, heights), (azimuth, azimuths_deg)
        for value, (low, high) in bounds:
            inside = inside & (value >= low) & (value <= high)
        return torch.where(inside[..., None], paint(points), base(points))

    return albedo


def marked(base: Texture, marks: Texture) -> Texture:
    """Return a texture darkened by a second one, such as by blemishes."""
    return lambda points: base(points) * marks(points)
