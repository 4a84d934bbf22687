"""Whether the frames of a result and of the truth meet, and a guess at their difference if not."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.metrics.surface_distances import sample_surface
from pimper_torch.ground.geometry.nearest import NearestSurface
from pimper_torch.ground.geometry.rigid import rigid, transform
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import InputError

_SAMPLES = 500  # of each surface: a choice
# Distances below are medians, as fractions of the truth's diagonal, and choices. A ball that is a
# third larger than the true one is 0.1 from it.
_MEETS = 0.1
_APART = 0.5
_FITS = 0.03
_LARGEST_RATIO = 20.0  # of sizes, also of a result that has its surroundings: a choice
_UNITS = {
    1000.0: "metres and millimetres",
    100.0: "metres and centimetres",
    25.4: "inches and millimetres",
    10.0: "centimetres and millimetres",
}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Guess(Record):
    """A similarity that brings a result and the truth together.

    Attributes:
        told: The difference of the frames, for a message.
    """

    truth_from_world: Float[Tensor, "4 4"]
    told: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Sampled:
    """A surface with samples and their box."""

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
        """Return the median distance of points; of far ones to the box, as searches are slow."""
        beside = (self.low - points).clamp_min(0) + (points - self.high).clamp_min(0)
        distance = beside.norm(dim=1)
        near = distance < 2 * self.size
        distance[near] = self.surface.query(points[near]).distance
        return float(distance.median())


class Frames:
    """A result and the truth, compared as they are and under guesses.

    Args:
        mesh: The result, in the frame that is taken for that of the truth.
        truth: Surface or point cloud.
    """

    def __init__(self, mesh: Mesh, truth: Mesh) -> None:
        self._ours, self._truth = _Sampled.of(mesh), _Sampled.of(truth)
        self._here = self._distances(torch.eye(4).double())

    def require_met(self, method: str, cameras: int) -> None:
        """Refuse surfaces that are apart, or that other units, axes or a shift bring together.

        Args:
            method: That they were aligned by.
            cameras: That both have.
        """
        guess = self.guess()
        if guess is None and min(self._here) <= _APART:
            return
        if method == "cameras":
            advice = (
                f"They were aligned by {cameras} cameras: check that equal names are the same "
                "photographs, and that the result is in the frame of its cameras."
            )
        elif method == "none" and cameras >= 2:
            advice = f"Align them by the {cameras} cameras that both have (`--alignment cameras`)."
        elif method == "none" and guess:
            advice = "`--alignment icp` begins with that."
        else:
            advice = (
                "Move the result to the frame of the truth, or give a folder whose cameras the "
                "truth has (`--alignment cameras`)."
            )
        ours, truth = self._ours, self._truth
        between = float((ours.center - truth.center).norm())
        raise InputError(
            f"the result and the truth are in different frames: the result is {ours.size:.4g} "
            f"across, the truth {truth.size:.4g}, and their centres are {between:.4g} apart. "
            f"{f'They fit if {guess.told}. ' if guess else ''}{advice}"
        )

    def guess(self) -> Guess | None:
        """Return other units, axes or a shift that bring the surfaces together.

        Returns:
            ``None`` where they meet already, or where none does.
        """
        plain = max(self._here)
        if plain <= _MEETS:
            return None
        scale = self._scale()
        centered = [(axes, self._about_center(scale * axes)) for axes in _axes()]
        found = [max(self._distances(one)) for _, one in centered]
        least = min(found)
        if least > min(_FITS, plain / 3):
            return None
        # Symmetric objects fit under several: the first is the plainest.
        tie = least + _FITS / 3
        axes, best = next(one for one, far in zip(centered, found, strict=True) if far <= tie)
        about_origin = rigid(scale * axes, torch.zeros(3).double())
        if max(self._distances(about_origin)) <= tie:
            best = about_origin
        return Guess(truth_from_world=best, told=_told(scale, axes, best[:3, 3]))

    def _distances(self, truth_from_world: Float[Tensor, "4 4"]) -> tuple[float, float]:
        """Return median distances to the truth and from it, over the truth's diagonal."""
        ours, truth = self._ours, self._truth
        scale = float(torch.linalg.det(truth_from_world[:3, :3])) ** (1 / 3)
        ratio = scale * ours.size / truth.size
        if not 1 / _LARGEST_RATIO < ratio < _LARGEST_RATIO:
            return torch.inf, torch.inf
        moved = transform(truth_from_world, ours.points)
        back = transform(torch.linalg.inv(truth_from_world), truth.points)
        return truth.distance(moved) / truth.size, scale * ours.distance(back) / truth.size

    def _scale(self) -> float:
        """Return the ratio of sizes: of units that are near it; 1 where they are similar."""
        ratio = self._truth.size / self._ours.size
        if 0.5 < ratio < 2:
            return 1.0
        known = (known for unit in _UNITS for known in (unit, 1 / unit))
        return next((one for one in known if 0.9 < ratio / one < 1.1), ratio)

    def _about_center(self, linear: Float[Tensor, "3 3"]) -> Float[Tensor, "4 4"]:
        moved = transform(rigid(linear, torch.zeros(3).double()), self._ours.points)
        low, high = moved.aminmax(dim=0)
        return rigid(linear, self._truth.center - (low + high) / 2)


def _axes() -> Iterator[Float[Tensor, "3 3"]]:
    """Yield the 24 rotations that carry axes to axes, the identity first."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        rotation = torch.tensor(signs).double()[:, None] * torch.eye(3).double()[[*order]]
        if torch.linalg.det(rotation) > 0:
            yield rotation


def _told(scale: float, axes: Float[Tensor, "3 3"], translation: Float[Tensor, " 3"]) -> str:
    """List the parts of a guess: units, axes and a shift."""
    parts = []
    if scale != 1:
        factor = max(scale, 1 / scale)
        units = f" ({_UNITS[factor]}?)" if factor in _UNITS else ""
        how = "larger" if scale > 1 else "smaller"
        parts.append(f"the result is made {factor:.4g} times {how}{units}")
    if not torch.equal(axes, torch.eye(3).double()):
        names = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(row.abs().argmax())]}" for row in axes]
        parts.append(f"x, y, z of the truth are {', '.join(names)} of the result")
    if bool(translation.any()):
        parts.append(f"the result is moved by ({', '.join(f'{one:.4g}' for one in translation)})")
    return " and ".join(parts)
