"""Test whether a result and the truth are in one frame, and a guess of their difference if not."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.metrics.surface_distances import sample_surface
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import InputError

_SAMPLES = 500  # of each surface: a choice
# Distances below are medians, as fractions of the truth's diagonal, and choices. A ball that is a
# third larger than the true one has a distance of 0.1.
_MEETS = 0.1
_APART = 0.5
_FITS = 0.03
_LARGEST_RATIO = 20.0  # of sizes, also of a result that includes its surroundings: a choice
_UNITS = {
    1000.0: "metres and millimetres",
    100.0: "metres and centimetres",
    25.4: "inches and millimetres",
    10.0: "centimetres and millimetres",
}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Guess(Record):
    """A similarity that aligns a result with the truth.

    Attributes:
        description: The difference of the frames, for a message.
    """

    truth_from_world: Float[Tensor, "4 4"]
    description: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Sampled:
    """A surface with samples and their bounding box."""

    surface: NearestSurface
    points: Float[Tensor, "sample 3"]
    low: Float[Tensor, " 3"]
    high: Float[Tensor, " 3"]

    @classmethod
    def of(cls, mesh: Mesh) -> "_Sampled":
        drawn = sample_surface(mesh, _SAMPLES, torch.Generator().manual_seed(0)).points
        low, high = drawn.aminmax(dim=0)
        return cls(surface=NearestSurface(mesh), points=drawn, low=low, high=high)

    @property
    def size(self) -> float:
        return max(float((self.high - self.low).norm()), 1e-300)  # of a single point

    @property
    def center(self) -> Float[Tensor, " 3"]:
        return (self.low + self.high) / 2

    def distance(self, points: Float[Tensor, "sample 3"]) -> float:
        """Return the median distance of points; of far points, to the box, as searches are slow."""
        outside = (self.low - points).clamp_min(0) + (points - self.high).clamp_min(0)
        distance = outside.norm(dim=1)
        near = distance < 2 * self.size
        distance[near] = self.surface.query(points[near]).distance
        return float(distance.median())


class Frames:
    """A result and the truth, compared as given and under guesses.

    Args:
        mesh: The result, assumed to be in the frame of the truth.
        truth: Surface or point cloud.
    """

    def __init__(self, mesh: Mesh, truth: Mesh) -> None:
        self._ours, self._truth = _Sampled.of(mesh), _Sampled.of(truth)
        self._distance = self._distances(torch.eye(4).double())

    def require_met(self, method: str, cameras: int) -> None:
        """Raise if surfaces are apart, or if other units, axes or a translation align them.

        Args:
            method: Method of the alignment.
            cameras: Number of common cameras.
        """
        guess = self.guess()
        if guess is None and min(self._distance) <= _APART:
            return
        if method == "cameras":
            advice = (
                f"They were aligned by {cameras} cameras: check that equal names are the same "
                "photographs, and that the result is in the frame of its cameras."
            )
        elif method == "none" and cameras >= 2:
            advice = f"Align them by their {cameras} common cameras (`--alignment cameras`)."
        elif method == "none" and guess:
            advice = "`--alignment icp` starts from that."
        else:
            advice = (
                "Transform the result to the frame of the truth, or give a folder that has cameras "
                "in common with the truth (`--alignment cameras`)."
            )
        ours, truth = self._ours, self._truth
        between = float((ours.center - truth.center).norm())
        raise InputError(
            f"the result and the truth are in different frames: the result is {ours.size:.4g} "
            f"across, the truth {truth.size:.4g}, and their centres are {between:.4g} apart. "
            f"{f'They fit if {guess.description}. ' if guess else ''}{advice}"
        )

    def guess(self) -> Guess | None:
        """Return other units, axes or a translation that align the surfaces.

        Returns:
            ``None`` if they are aligned already, or if no guess aligns them.
        """
        plain = max(self._distance)
        if plain <= _MEETS:
            return None
        scale = self._scale()
        centered = [(axes, self._about_center(scale * axes)) for axes in _axes()]
        distances = [max(self._distances(guess)) for _, guess in centered]
        least = min(distances)
        if least > min(_FITS, plain / 3):
            return None
        # Symmetric objects fit under several: use the first, which is the simplest.
        tie = least + _FITS / 3
        axes, best = next(g for g, far in zip(centered, distances, strict=True) if far <= tie)
        about_origin = rigid(scale * axes, torch.zeros(3).double())
        if max(self._distances(about_origin)) <= tie:
            best = about_origin
        return Guess(truth_from_world=best, description=_described(scale, axes, best[:3, 3]))

    def _distances(self, truth_from_world: Float[Tensor, "4 4"]) -> tuple[float, float]:
        """Return median distances to the truth and from it, as fractions of its diagonal."""
        ours, truth = self._ours, self._truth
        scale = float(torch.linalg.det(truth_from_world[:3, :3])) ** (1 / 3)
        ratio = scale * ours.size / truth.size
        if not 1 / _LARGEST_RATIO < ratio < _LARGEST_RATIO:
            return torch.inf, torch.inf
        moved = transform(truth_from_world, ours.points)
        back = transform(torch.linalg.inv(truth_from_world), truth.points)
        return truth.distance(moved) / truth.size, scale * ours.distance(back) / truth.size

    def _scale(self) -> float:
        """Return the ratio of sizes: that of common units if near; 1 if sizes are similar."""
        ratio = self._truth.size / self._ours.size
        if 0.5 < ratio < 2:
            return 1.0
        ratios = (value for unit in _UNITS for value in (unit, 1 / unit))
        return next((value for value in ratios if 0.9 < ratio / value < 1.1), ratio)

    def _about_center(self, linear: Float[Tensor, "3 3"]) -> Float[Tensor, "4 4"]:
        moved = transform(rigid(linear, torch.zeros(3).double()), self._ours.points)
        low, high = moved.aminmax(dim=0)
        return rigid(linear, self._truth.center - (low + high) / 2)


def _axes() -> Iterator[Float[Tensor, "3 3"]]:
    """Yield the 24 rotations between axes, the identity first."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        rotation = torch.tensor(signs).double()[:, None] * torch.eye(3).double()[[*order]]
        if torch.linalg.det(rotation) > 0:
            yield rotation


def _described(scale: float, axes: Float[Tensor, "3 3"], translation: Float[Tensor, " 3"]) -> str:
    """Describe a guess: units, axes and a translation."""
    parts = []
    if scale != 1:
        factor = max(scale, 1 / scale)
        units = f" ({_UNITS[factor]}?)" if factor in _UNITS else ""
        change = "enlarged" if scale > 1 else "reduced"
        parts.append(f"the result is {change} by a factor of {factor:.4g}{units}")
    if not torch.equal(axes, torch.eye(3).double()):
        names = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(row.abs().argmax())]}" for row in axes]
        parts.append(f"x, y, z of the truth are {', '.join(names)} of the result")
    if bool(translation.any()):
        parts.append(f"the result is moved by ({', '.join(f'{t:.4g}' for t in translation)})")
    return " and ".join(parts)
