"""Trimmed iterative closest points with scale: a similarity between two surfaces."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.config import Range, require_ranges
from pimper_torch.evidence.metrics.sampling import sample_surface
from pimper_torch.evidence.metrics.similarity import similarity_between_points
from pimper_torch.geometry.frames import rigid, transform
from pimper_torch.geometry.nearest import Nearest, NearestSurface
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import Mesh, Record

# A direction of the seven that moves the surface less than this fraction of the strongest is no
# direction: turning a ball, sliding a plane.
_UNDETERMINED = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpConfig:
    """How two surfaces are brought together.

    Attributes:
        trimmed_fraction: Fraction of the estimate's samples, those farthest from the truth, that
            each step leaves out. It must cover outliers and whatever the truth lacks; what
            the estimate lacks needs none, for only its own samples look for partners.
        samples: Of the estimate.
        iterations: At most.
        tolerance: Stop when a step moves the samples by less than this fraction of their
            spread.
    """

    trimmed_fraction: Annotated[float, Range(least=0, below=1)] = 0.2
    samples: Annotated[int, Range(least=100, most=10_000_000)] = 8000  # 100 bytes each
    iterations: Annotated[int, Range(least=1, most=100_000)] = 60
    tolerance: Annotated[float, Range(above=0, most=1)] = 1e-7

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpResult(Record):
    """Where the estimate was put.

    Attributes:
        truth_from_world: Similarity.
        distance: Along true normals to the ``plane``, or to the nearest ``point`` of a truth
            without faces.
        residual: Root mean square distance of the samples that were kept, scene units.
        converged: False where the limit of iterations stopped it.
    """

    truth_from_world: Float[Tensor, "4 4"]
    distance: str
    residual: float
    iterations: int
    converged: bool


def trimmed_icp(
    mesh: Mesh,
    truth: Mesh,
    start: Float[Tensor, "4 4"],
    config: IcpConfig | None = None,
    *,
    generator: torch.Generator,
) -> IcpResult:
    """Find the similarity that lays an estimate on the truth, beginning near it.

    Each step pairs every sample of the estimate with the nearest point of the true surface,
    drops the fraction of pairs that are farthest apart, and moves the estimate by the
    similarity that is best for the rest. It finds the nearest minimum only, and the scale
    is part of it: an estimate that starts far off may shrink into a corner of the truth, so
    look at the scale that is reported.

    Args:
        truth: Surface or point cloud; with its surroundings, if the estimate may have them.
        start: ``truth_from_world`` to begin with.
        generator: On the CPU.

    Source: Chetverikov, Stepanov & Krsek, IVC 23(3), 2005, for trimming; Chen & Medioni,
    IVC 10(3), 1992, for the distance to the plane. Scale as a seventh unknown of the
    linearised step is ours.
    """
    config = config or IcpConfig()
    target = NearestSurface(truth)
    normals = face_normals(truth.vertices_world.cpu().double(), truth.faces.cpu())
    by_plane = len(truth.faces) > 0
    samples = sample_surface(mesh, config.samples, generator).points
    kept = max(3, round((1 - config.trimmed_fraction) * len(samples)))
    found = start.cpu().double()
    spread = _spread(transform(found, samples))
    converged, taken = False, 0
    while taken < config.iterations and not converged:
        moved = transform(found, samples)
        nearest = target.query(moved)
        chosen = nearest.distance.topk(kept, largest=False).indices
        source, aim = moved[chosen], nearest.points[chosen]
        if by_plane:
            step = _step_to_planes(source, aim, normals[nearest.face[chosen]])
        else:
            step = similarity_between_points(source, aim)
        found = step @ found
        taken += 1
        length = (transform(step, moved) - moved).square().sum(dim=1).mean().sqrt()
        converged = float(length) < config.tolerance * spread
    rest: Nearest = target.query(transform(found, samples))
    near = rest.distance.topk(kept, largest=False).values
    return IcpResult(
        truth_from_world=found,
        distance="plane" if by_plane else "point",
        residual=float(near.square().mean().sqrt()),
        iterations=taken,
        converged=converged,
    )


def _step_to_planes(
    source: Float[Tensor, "pair 3"],
    target: Float[Tensor, "pair 3"],
    normals: Float[Tensor, "pair 3"],
) -> Float[Tensor, "4 4"]:
    """Solve for the small rotation, translation and change of scale about the mean.

    The residual ``n . (p - q)`` changes by ``n . (w x p + t + s p)``, linear in w, t and s.
    Those of the seven unknowns that the planes leave open stay zero.
    """
    centre = source.mean(dim=0)
    size = _spread(source)
    local = (source - centre) / size
    unit = normals / normals.norm(dim=1, keepdim=True).clamp_min(torch.finfo(normals.dtype).tiny)
    gap = ((target - source) * unit).sum(dim=1) / size
    rotation = torch.linalg.cross(local, unit)
    grow = (local * unit).sum(dim=1, keepdim=True)
    rows = torch.cat([rotation, unit, grow], dim=1)
    solution = torch.linalg.pinv(rows.mT @ rows, rtol=_UNDETERMINED, hermitian=True) @ (
        rows.mT @ gap
    )
    w, t, s = solution[:3], solution[3:6], solution[6]
    zero = torch.zeros_like(s)
    skew = torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
    linear = s.exp() * torch.linalg.matrix_exp(skew)
    return rigid(linear, centre + size * t - linear @ centre)


def _spread(points: Float[Tensor, "point 3"]) -> float:
    return float((points - points.mean(dim=0)).square().sum(dim=1).mean().sqrt())
