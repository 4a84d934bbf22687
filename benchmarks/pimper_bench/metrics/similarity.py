"""Similarities from the frame of a result to that of the truth.

They are 4x4 matrices ``truth_from_world`` whose upper left block is scale times rotation;
:func:`pimper_torch.geometry.rigid.transform` applies them.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.frames import Frames
from pimper_bench.metrics.surface_distances import sample_surface, true_surface, with_surroundings
from pimper_bench.truth import Capture
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import Cameras, Mesh, Record
from pimper_torch.runtime.errors import InputError, caution

# Choices. The first two are for centres and rotations in agreement, the last for optical axes.
_MOST_RESIDUAL = 0.1  # root mean square of the centres' distances, over that from their mean
_MOST_TURNED_DEG = 45.0
_MOST_OFF_DEG = 15.0


def pair_views(
    names: Sequence[str], names_true: Sequence[str]
) -> tuple[Int[Tensor, " pair"], Int[Tensor, " pair"]]:
    """Pair views of the same name, for results that lack some of the photographs.

    If a name is not among the true ones, it is paired with the view whose name differs only in
    folder and suffix: ``raw/07.tif`` and ``07.png``. A stem that is not unique in a set is
    not paired.

    Returns:
        Indices in ``names`` and in ``names_true``, in the order of the former; at least one.
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
            f"no view is in both sets: {', '.join(names[:3])}, ... and "
            f"{', '.join(names_true[:3])}, ... Use the same names for the photographs in both."
        )
    ours, truth = torch.tensor(pairs).unbind(dim=1)
    return ours, truth


def _stems(names: Sequence[str]) -> dict[str, int]:
    """Return the index of every unique stem."""
    stems = [PurePath(name).stem for name in names]
    counts = Counter(stems)
    return {stem: index for index, stem in enumerate(stems) if counts[stem] == 1}


def similarity_between_points(
    points: Float[Tensor, "point 3"], points_true: Float[Tensor, "point 3"]
) -> Float[Tensor, "4 4"]:
    """Return the least-squares similarity from points to true points.

    Three points not on a line determine it; fewer leave a rotation undetermined.

    Source: Umeyama, PAMI 13(4), 1991.
    """
    source, target = points.double(), points_true.double()
    return _similarity(source, target, _outer(target, source)).to(points)


def similarity_between_cameras(ours: Cameras, truth: Cameras) -> Float[Tensor, "4 4"]:
    """Return the similarity from our cameras to the true ones, which are in the same order.

    Scale and translation are Umeyama's on the cameras' centres. Centres on a line leave a rotation
    about it undetermined, so the rotation is fitted to the centres and the cameras' axes
    together, each axis scaled to the centres' root mean square distance from their mean.
    """
    if ours.num_views != truth.num_views:
        raise InputError(
            f"got {ours.num_views} cameras and {truth.num_views} true ones; needed: the same "
            "views in the same order. Pair them by name first."
        )
    source, target = ours.centers_world.double(), truth.centers_world.double()
    axes = ours.cam_from_world[:, :3, :3].double()  # rows are the axes in the world
    axes_true = truth.cam_from_world[:, :3, :3].double()
    length = _spread(source).sqrt() * _spread(target).sqrt()
    correlation = _outer(target, source) + length * (axes_true.mT @ axes).mean(dim=0)
    return _similarity(source, target, correlation).to(ours.cam_from_world)


def rolled_cameras(ours: Cameras, truth: Cameras) -> tuple[Float[Tensor, "4 4"], str] | None:
    """Detect cameras with true positions that are rotated about their optical axes or reversed.

    Returns:
        The similarity on centres and optical axes only, and a sentence on the difference; ``None``
        if centres and rotations agree, or disagree in a different way.
    """
    source, target = ours.centers_world.double(), truth.centers_world.double()
    axes = ours.cam_from_world[:, :3, :3].double()
    axes_true = truth.cam_from_world[:, :3, :3].double()
    length = _spread(source).sqrt() * _spread(target).sqrt()
    outer = _outer(target, source)

    def fitted(rows: slice, sign: float) -> tuple[Float[Tensor, "3 3"], float, Tensor]:
        """Return a correlation, the centres' residual over their spread, and residual rotations."""
        pulled = (axes_true[:, rows].mT @ axes[:, rows]).mean(dim=0)
        correlation = outer + sign * length * pulled
        rotation = nearest_rotation(correlation)
        common = float((rotation * outer).sum().clamp_min(0) / length)
        return correlation, max(0, 1 - common) ** 0.5, axes_true @ rotation @ axes.mT

    if not float(length):
        return None
    _, residual_all, turned = fitted(slice(0, 3), 1)
    turned_deg = float(rotation_angles_deg(turned).median())
    if residual_all <= _MOST_RESIDUAL and turned_deg <= _MOST_TURNED_DEG:
        return None
    for sign in (1, -1):
        correlation, residual, turned = fitted(slice(2, 3), sign)
        off = torch.rad2deg(torch.arccos((sign * turned[:, 2, 2]).clamp(-1, 1))).median()
        rolls = torch.rad2deg(torch.atan2(turned[:, 1, 0], turned[:, 0, 0])).abs().median()
        clear = residual <= max(_MOST_RESIDUAL, residual_all / 3) and float(off) <= _MOST_OFF_DEG
        if clear and (sign < 0 or float(rolls) > _MOST_TURNED_DEG):
            difference = (
                f"they are turned about their optical axes by {float(rolls):.0f} degrees "
                "in the median. Does one have photographs as EXIF turns them, the other as stored?"
                if sign > 0
                else "their axes are opposite. Does one have OpenGL's axes (y up, z backwards)?"
            )
            fit = _similarity(source, target, correlation).to(ours.cam_from_world)
            return fit, f"the positions of the cameras of result and truth agree, but {difference}"
    return None


def nearest_rotation(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation ``R`` that maximizes ``trace(R^T matrix)``; never a reflection."""
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
    """Return the angles of rotations, also accurate for small angles."""
    skew = rotation - rotation.mT
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1).norm(dim=-1)
    cosine = rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1
    return torch.rad2deg(torch.atan2(sine, cosine))


def _similarity(
    source: Float[Tensor, "point 3"],
    target: Float[Tensor, "point 3"],
    correlation: Float[Tensor, "3 3"],
) -> Float[Tensor, "4 4"]:
    """Return the similarity with the correlation's rotation; points give scale and translation."""
    if _spread(source) == 0 or _spread(target) == 0:
        raise InputError(
            f"all {len(source)} points or camera centres of the alignment coincide, so the scale "
            "is undetermined; needed: at least two different positions."
        )
    rotation = nearest_rotation(correlation)
    scale = (rotation * _outer(target, source)).sum() / _spread(source)
    if scale <= 0:
        raise InputError(
            f"the {len(source)} points or camera centres of the alignment do not correspond to the "
            "true ones: no similarity brings them nearer. Check that their names match."
        )
    translation = target.mean(dim=0) - scale * rotation @ source.mean(dim=0)
    return rigid(scale * rotation, translation)


def _outer(
    target: Float[Tensor, "point 3"], source: Float[Tensor, "point 3"]
) -> Float[Tensor, "3 3"]:
    return (target - target.mean(dim=0)).mT @ (source - source.mean(dim=0)) / len(source)


def _spread(points: Float[Tensor, "point 3"]) -> Float[Tensor, ""]:
    return (points - points.mean(dim=0)).square().sum(dim=1).mean()


Method = Literal["auto", "none", "cameras", "icp"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment(Record):
    """A similarity, and its method.

    Attributes:
        truth_from_world: Upper left block is scale times rotation.
        scale: Scene units of the truth per unit of the estimate.
        cameras: Number of camera pairs used.
        trimmed_fraction: Fraction of the samples excluded by ``icp``; ``None`` otherwise.
        residual: Root mean square distance of the samples kept by ``icp``, scene units.
        converged: False if ``icp`` reached the maximum of iterations; ``None`` without ``icp``.
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
    trimmed_fraction: float = 0.2,
    *,
    generator: torch.Generator,
) -> Alignment:
    """Return the similarity from an estimate to the truth.

    Args:
        method: ``none`` assumes that the frames are the same. ``cameras`` fits the
            estimate's cameras to the true ones of the same names. ``icp`` continues from
            there, or from the identity, or from a guess if the surfaces are apart (see
            :class:`.Frames`), and fits the surfaces, see :func:`trimmed_icp`.
            ``auto`` is ``cameras`` if there are at least two pairs of cameras, else ``none``.
        generator: On the CPU; draws the samples of ``icp``.

    Raises:
        InputError: ``cameras`` without two pairs, or with cameras that disagree by their rolls
            (see :func:`rolled_cameras`), or ``icp`` without a true surface.
    """
    pairs = paired_cameras(estimate, capture)
    count = 0 if pairs is None else pairs[0].num_views
    if method == "cameras" and count < 2:
        raise InputError(
            f"to align by cameras, {count} views have a camera in both the result and the truth; "
            "needed: at least two. Align by the surfaces (`icp`), or not at all (`none`)."
        )
    similarity, used = torch.eye(4).double(), 0
    if pairs is not None and count >= 2:
        rolled = rolled_cameras(*pairs)
        if rolled is not None and method in ("auto", "cameras"):
            raise InputError(
                f"{rolled[1]} `--alignment icp` starts without their rolls; `none` assumes that "
                "the frames are the same."
            )
        if rolled is not None:
            caution(f"{rolled[1]} Figures of the cameras are omitted.")
        if method != "none":
            fitted = similarity_between_cameras(*pairs) if rolled is None else rolled[0]
            similarity, used = fitted.cpu().double(), count
    icp_figures: dict[str, float | None] = {}
    description = f"similarity on {used} cameras" if used else "identity"
    if method == "icp":
        target = with_surroundings(true_surface(capture), capture.truth)
        moved = transfer(estimate.mesh, similarity)
        guess = Frames(moved, true_surface(capture)).guess()
        if guess is not None:
            similarity = guess.truth_from_world @ similarity
            description += f", by a guess: {guess.description}"
        kind = "plane" if len(target.faces) else "point"
        description = (
            f"similarity ICP, point to {kind}, {100 * trimmed_fraction:g} % of the estimate "
            f"trimmed, from {description}"
        )
        similarity, icp_figures["residual"], icp_figures["converged"] = trimmed_icp(
            estimate.mesh, target, similarity, trimmed_fraction, generator=generator
        )
        icp_figures["trimmed_fraction"] = trimmed_fraction
    elif not used:
        description = "none: the frames are assumed to be the same"
    scale, rotation = split_similarity(similarity)
    return Alignment(
        method="icp" if method == "icp" else "cameras" if used else "none",
        description=description,
        truth_from_world=similarity,
        scale=scale,
        rotation_deg=float(rotation_angles_deg(rotation)),
        cameras=used,
        **icp_figures,  # type: ignore[arg-type]
    )


def trimmed_icp(
    mesh: Mesh,
    truth: Mesh,
    start: Float[Tensor, "4 4"],
    trimmed_fraction: float = 0.2,
    *,
    generator: torch.Generator,
    count: int = 8000,
    iterations: int = 60,
    tolerance: float = 1e-7,
) -> tuple[Float[Tensor, "4 4"], float, bool]:
    """Return the similarity from an estimate to the truth by ICP, starting near it.

    Each step pairs every sample of the estimate with the nearest point of the true surface,
    drops the fraction of pairs that are farthest apart, and moves the estimate by the
    similarity that is best for the rest. It finds only the nearest minimum: an estimate that
    starts far off may shrink into a corner of the truth, so check the reported scale.

    Args:
        truth: Surface or point cloud; with its surroundings, if the estimate may include them.
        trimmed_fraction: Must include outliers and parts that the truth lacks.
        tolerance: Stop when a step moves the samples by less than this fraction of their spread.

    Returns:
        The similarity, the root mean square distance of the kept samples, and False if the
        maximum of iterations was reached.

    Source: Chetverikov, Stepanov & Krsek, IVC 23(3), 2005, for trimming; Chen & Medioni,
    IVC 10(3), 1992, for the distance to the plane. Scale as a seventh unknown of the
    linearised step is ours.
    """
    target = NearestSurface(truth)
    normals = face_normals(truth.vertices_world.cpu().double(), truth.faces.cpu())
    samples = sample_surface(mesh, count, generator).points
    kept = max(3, round((1 - trimmed_fraction) * len(samples)))
    similarity = start.cpu().double()
    spread = _deviation(transform(similarity, samples))
    converged, steps = False, 0
    while steps < iterations and not converged:
        moved = transform(similarity, samples)
        nearest = target.query(moved)
        chosen = nearest.distance.topk(kept, largest=False).indices
        source, aim = moved[chosen], nearest.points[chosen]
        if len(truth.faces):
            step = _step_to_planes(source, aim, normals[nearest.face[chosen]])
        else:
            step = similarity_between_points(source, aim)
        similarity = step @ similarity
        steps += 1
        length = (transform(step, moved) - moved).square().sum(dim=1).mean().sqrt()
        converged = float(length) < tolerance * spread
    near = target.query(transform(similarity, samples)).distance.topk(kept, largest=False).values
    return similarity, float(near.square().mean().sqrt()), converged


def _step_to_planes(
    source: Float[Tensor, "pair 3"],
    target: Float[Tensor, "pair 3"],
    normals: Float[Tensor, "pair 3"],
) -> Float[Tensor, "4 4"]:
    """Return the small rotation, translation and change of scale about the mean.

    The residual ``n . (p - q)`` changes by ``n . (w x p + t + s p)``, linear in w, t and s.
    Unknowns of the seven that the planes leave undetermined stay zero.
    """
    centre = source.mean(dim=0)
    size = _deviation(source)
    local = (source - centre) / size
    unit = normals / normals.norm(dim=1, keepdim=True).clamp_min(torch.finfo(normals.dtype).tiny)
    gap = ((target - source) * unit).sum(dim=1) / size
    rotation = torch.linalg.cross(local, unit)
    grow = (local * unit).sum(dim=1, keepdim=True)
    rows = torch.cat([rotation, unit, grow], dim=1)
    # Rotating a ball or sliding a plane changes nothing: such directions are cut off.
    solution = torch.linalg.pinv(rows.mT @ rows, rtol=1e-6, hermitian=True) @ (rows.mT @ gap)
    w, t, s = solution[:3], solution[3:6], solution[6]
    zero = torch.zeros_like(s)
    skew = torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
    linear = s.exp() * torch.linalg.matrix_exp(skew)
    return rigid(linear, centre + size * t - linear @ centre)


def _deviation(points: Float[Tensor, "point 3"]) -> float:
    return float((points - points.mean(dim=0)).square().sum(dim=1).mean().sqrt())


def paired_cameras(estimate: Estimate, capture: Capture) -> tuple[Cameras, Cameras] | None:
    """Return the cameras of the common views; ``None`` without any."""
    if estimate.cameras is None or capture.cameras is None:
        return None
    try:
        ours, truth = pair_views(estimate.names, capture.views.names)
    except InputError:
        return None
    return estimate.cameras.take(ours.tolist()), capture.cameras.take(truth.tolist())


def transfer(mesh: Mesh, truth_from_world: Float[Tensor, "4 4"]) -> Mesh:
    """Transform a mesh to the frame of the truth by a similarity, in float64 on the CPU."""
    mesh = mesh.to("cpu")
    scale, rotation = split_similarity(truth_from_world)
    normals, error = mesh.normals_world, mesh.expected_error
    return mesh.replace(
        vertices_world=transform(truth_from_world.cpu().double(), mesh.vertices_world.double()),
        normals_world=None if normals is None else normals.double() @ rotation.cpu().double().mT,
        expected_error=None if error is None else float(scale) * error.double(),
    )
