"""Similarities that put a result in the frame of the truth.

They are 4x4 matrices ``truth_from_world`` whose upper left block is scale times rotation;
:func:`pimper_torch.geometry.frames.transform` applies them.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.config import Range, require_ranges
from pimper_torch.errors import InputError
from pimper_torch.evidence.metrics.surface_distances import joined, sample_surface, true_surface
from pimper_torch.geometry.frames import rigid, transform
from pimper_torch.geometry.nearest import Nearest, NearestSurface
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import Cameras, Capture, Estimate, Mesh, Record


def pair_views(
    names: Sequence[str], names_true: Sequence[str]
) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Find views of the same name, for results that miss some of the photographs.

    Where a name is not among the true ones, the view whose name differs in folder and suffix
    alone is the same: ``raw/07.tif`` and ``07.png``. A stem that two views of a set share
    pairs nothing.

    Returns:
        Indices in ``names`` and in ``names_true``, in the order of the former.

    Raises:
        InputError: No name is in both.
    """
    index_of = {name: index for index, name in enumerate(names_true)}
    by_stem, by_stem_true = _stems(names), _stems(names_true)
    pairs: list[tuple[int, int]] = []
    for index, name in enumerate(names):
        stem = PurePath(name).stem
        if name in index_of:
            pairs.append((index, index_of[name]))
        elif by_stem.get(stem) == index and by_stem_true.get(stem) is not None:
            pairs.append((index, by_stem_true[stem]))
    if not pairs:
        raise InputError(
            f"no view is in both sets: found {', '.join(names[:3])}, ... and "
            f"{', '.join(names_true[:3])}, ... Give the photographs the same names in both."
        )
    ours, truth = torch.tensor(pairs).unbind(dim=1)
    return ours, truth


def _stems(names: Sequence[str]) -> dict[str, int]:
    """Return the index of every stem that one name alone has."""
    stems = [PurePath(name).stem for name in names]
    counts = Counter(stems)
    return {stem: index for index, stem in enumerate(stems) if counts[stem] == 1}


def similarity_between_points(
    points: Float[Tensor, "point 3"], points_true: Float[Tensor, "point 3"]
) -> Float[Tensor, "4 4"]:
    """Return the similarity that carries points nearest to true ones, in least squares.

    Solved in float64. Three points not on a line determine it; fewer leave a rotation open.

    Raises:
        InputError: All points coincide, so that nothing tells the scale.

    Source: Umeyama, PAMI 13(4), 1991.
    """
    source, target = points.double(), points_true.double()
    return _similarity(source, target, _outer(target, source)).to(points)


def similarity_between_cameras(ours: Cameras, truth: Cameras) -> Float[Tensor, "4 4"]:
    """Return the similarity that carries our cameras nearest to the true ones.

    Scale and translation are Umeyama's on the cameras' centres. Centres on a line leave a
    rotation about it open, and an arc nearly does; so the rotation is fitted to the centres
    and to the cameras' axes together, each axis drawn as long as the centres' root mean
    square distance from their mean.

    Args:
        ours: World frame of the result.
        truth: The same views in the same order; see :func:`pair_views`.

    Raises:
        InputError: Unequal numbers of cameras, or centres that coincide.
    """
    if ours.num_views != truth.num_views:
        raise InputError(
            f"found {ours.num_views} cameras and {truth.num_views} true ones; needed: the same "
            "views in the same order. Pair them by name first."
        )
    source, target = ours.centers_world.double(), truth.centers_world.double()
    axes = ours.cam_from_world[:, :3, :3].double()  # rows are the axes in the world
    axes_true = truth.cam_from_world[:, :3, :3].double()
    length = _spread(source).sqrt() * _spread(target).sqrt()
    correlation = _outer(target, source) + length * (axes_true.mT @ axes).mean(dim=0)
    return _similarity(source, target, correlation).to(ours.cam_from_world)


def nearest_rotation(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation ``R`` with the greatest ``trace(R^T matrix)``; never a reflection."""
    U, _, Vh = torch.linalg.svd(matrix)
    mirror = torch.ones(3).to(U)
    mirror[2] = torch.linalg.det(U @ Vh).sign()
    return U @ (mirror[:, None] * Vh)


def split_similarity(
    target_from_source: Float[Tensor, "4 4"],
) -> tuple[float, Float[Tensor, "3 3"]]:
    """Return the scale and the rotation of a similarity."""
    linear = target_from_source[:3, :3]
    scale = float(torch.linalg.det(linear)) ** (1 / 3)
    return scale, linear / scale


def rotation_angles_deg(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the angle of rotations, accurate for the smallest too."""
    skew = rotation - rotation.mT
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1).norm(dim=-1)
    cosine = rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1
    return torch.rad2deg(torch.atan2(sine, cosine))


def _similarity(
    source: Float[Tensor, "point 3"],
    target: Float[Tensor, "point 3"],
    correlation: Float[Tensor, "3 3"],
) -> Float[Tensor, "4 4"]:
    """Rotate by the correlation, then fit scale and translation to the points."""
    if _spread(source) == 0 or _spread(target) == 0:
        raise InputError(
            f"the {len(source)} points or camera centres to align by coincide, so that nothing "
            "tells the scale; needed: two different positions at least."
        )
    rotation = nearest_rotation(correlation)
    scale = (rotation * _outer(target, source)).sum() / _spread(source)
    translation = target.mean(dim=0) - scale * rotation @ source.mean(dim=0)
    return rigid(scale * rotation, translation)


def _outer(
    target: Float[Tensor, "point 3"], source: Float[Tensor, "point 3"]
) -> Float[Tensor, "3 3"]:
    return (target - target.mean(dim=0)).mT @ (source - source.mean(dim=0)) / len(source)


def _spread(points: Float[Tensor, "point 3"]) -> Float[Tensor, ""]:
    return (points - points.mean(dim=0)).square().sum(dim=1).mean()


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
    spread = _deviation(transform(found, samples))
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
    size = _deviation(source)
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


def _deviation(points: Float[Tensor, "point 3"]) -> float:
    return float((points - points.mean(dim=0)).square().sum(dim=1).mean().sqrt())


Method = Literal["auto", "none", "cameras", "icp"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment(Record):
    """A similarity, and how it was found.

    Attributes:
        method: ``none``, ``cameras`` or ``icp``.
        description: In words, with whatever tells it from its kin.
        truth_from_world: Upper left block is scale times rotation.
        scale: Scene units of the truth in one of the estimate.
        cameras: How many pairs of cameras were used; 0 if none.
        trimmed_fraction: Fraction of the samples left out by ``icp``; ``None`` otherwise.
        residual: Root mean square distance of the samples ``icp`` kept, scene units.
        converged: Whether ``icp`` came to rest; ``None`` otherwise.
    """

    method: str
    description: str
    truth_from_world: Float[Tensor, "4 4"]
    scale: float
    rotation_deg: float
    cameras: int = 0
    trimmed_fraction: float | None = None
    residual: float | None = None
    converged: bool | None = None


def align_estimate(
    estimate: Estimate,
    capture: Capture,
    method: Method,
    icp: IcpConfig | None = None,
    *,
    generator: torch.Generator,
) -> Alignment:
    """Find the similarity that carries an estimate to the truth.

    Args:
        estimate: In a frame of its own.
        capture: The truth, with cameras if ``method`` needs some.
        method: ``none`` takes the frames for one and the same. ``cameras`` fits the
            estimate's cameras to the true ones of the same names. ``icp`` goes on from
            there (from the identity, if there are not two pairs of cameras) and fits the
            surfaces, see :func:`pimper_torch.evidence.metrics.similarity.trimmed_icp`. ``auto`` is
            ``cameras`` where there are at least two pairs of cameras, else ``none``.
        generator: On the CPU; draws the samples of ``icp``.

    Raises:
        InputError: ``cameras`` was asked for without two pairs, or ``icp`` without a true
            surface.
    """
    pairs = paired_cameras(estimate, capture)
    enough = pairs is not None and pairs[0].num_views >= 2
    if method == "none" or (method == "auto" and not enough):
        return _told("none", "none: the frames are taken for the same", torch.eye(4).double())
    if method == "cameras" and not enough:
        raise InputError(
            f"to align by cameras, {0 if pairs is None else pairs[0].num_views} views have a "
            "camera in both the result and the truth; needed: two at least. Align by the "
            "surfaces (`icp`), or not at all (`none`)."
        )
    start, used = torch.eye(4).double(), 0
    if pairs is not None and enough:
        ours, truth = pairs
        start, used = similarity_between_cameras(ours, truth).cpu().double(), ours.num_views
    if method != "icp":
        return _told("cameras", f"similarity on {used} cameras", start, cameras=used)
    target = joined(true_surface(capture), capture.truth.surroundings)
    found = trimmed_icp(estimate.mesh, target, start, icp, generator=generator)
    trimmed = (icp or IcpConfig()).trimmed_fraction
    origin = f"similarity on {used} cameras" if used else "identity"
    return _told(
        "icp",
        f"similarity ICP, point to {found.distance}, {100 * trimmed:g} % of the estimate "
        f"trimmed, from {origin}",
        found.truth_from_world,
        cameras=used,
        trimmed_fraction=trimmed,
        residual=found.residual,
        converged=found.converged,
    )


def paired_cameras(estimate: Estimate, capture: Capture) -> tuple[Cameras, Cameras] | None:
    """Return the cameras of the views that both have; ``None`` if there are none."""
    if estimate.cameras is None or capture.cameras is None:
        return None
    try:
        ours, truth = pair_views(estimate.names, capture.views.names)
    except InputError:
        return None
    return estimate.cameras.take(ours.tolist()), capture.cameras.take(truth.tolist())


def transfer(mesh: Mesh, truth_from_world: Float[Tensor, "4 4"]) -> Mesh:
    """Put a mesh in the frame of the truth by a similarity, in float64 on the CPU."""
    mesh = mesh.to("cpu")
    scale, rotation = split_similarity(truth_from_world)
    normals, error = mesh.normals_world, mesh.expected_error
    return mesh.replace(
        vertices_world=transform(truth_from_world.cpu().double(), mesh.vertices_world.double()),
        normals_world=None if normals is None else normals.double() @ rotation.cpu().double().mT,
        expected_error=None if error is None else float(scale) * error.double(),
    )


def _told(
    method: str,
    description: str,
    truth_from_world: Float[Tensor, "4 4"],
    **known: int | float | None,
) -> Alignment:
    scale, rotation = split_similarity(truth_from_world)
    return Alignment(
        method=method,
        description=description,
        truth_from_world=truth_from_world,
        scale=scale,
        rotation_deg=float(rotation_angles_deg(rotation)),
        **known,  # type: ignore[arg-type]
    )
