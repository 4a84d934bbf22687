"""Consistency checks of a capture: common mistakes in its conventions, by hypothesis testing.

Every mistake is a hypothesis with a way to undo it (:mod:`pimper_torch.camera_files.conventions`,
:mod:`.mistakes`). The capture as given and as corrected under each hypothesis are scored by the
measures that its data allow (:mod:`pimper_torch.evidence.datasets.evidence`), and a mistake is
reported where undoing it scores significantly higher.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.camera_files.conventions import CameraMistake, camera_mistakes
from pimper_torch.errors import InputError, PimperWarning
from pimper_torch.evidence.datasets.evidence import (
    depth_agreement,
    epipolar_agreement,
    match_features,
    points_in_sight,
    silhouette_coherence,
    silhouette_mismatch,
    silhouette_overlap,
)
from pimper_torch.evidence.datasets.findings import CheckReport, Comparison, Finding
from pimper_torch.evidence.datasets.orientation import check_lights, check_mesh, check_normals
from pimper_torch.evidence.metrics.sampling import sample_surface
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Capture, Mesh, Truth, Views

_MAX_VIEWS = 8
_MAX_POINTS = 20_000
# A mistake is reported where undoing it removes 40 % of the misfit and raises the mean score
# by 0.05: the right cameras of a solid of revolution may be a little worse than mirrored ones.
# Scores of matched features are far below 1, as many matches are wrong (0.34 with the right
# cameras of Middlebury's dino, 0.13 at most with wrong ones): there it is 2.5 times as many.
_LEFT, _MARGIN = 0.6, 0.05
_TIMES, _STEP = 2.5, 0.15
_TIE = 0.02
_HOPELESS = 0.1
_NOT_RIGID = 1e-3
_WHOLE = 0.98  # a mask that covers more of the photograph is ignored


@dataclass(frozen=True, slots=True, kw_only=True)
class _Subject:
    """The views that are checked: one a position, a few all along the capture."""

    views: Views
    cameras: Cameras
    truth: Truth
    masks: Bool[Tensor, "view height width"] | None


def check_capture(capture: Capture) -> CheckReport:
    """Find mistakes in a capture's cameras, normals, lights and mesh.

    Cameras are tested against the true surface in the masks (or in the photographs, if there
    are no masks), against depth maps of neighbouring views, by the visual hull of the masks,
    and, without any of these, by features matched between photographs. Normals are
    tested against depth or mesh, with the corrected cameras, and by facing the camera; lights
    by the shading they predict. ``report.comparisons`` lists what the capture's data allowed to
    test.

    Args:
        capture: Read from a data set or rendered. Up to eight positions are checked.

    Returns:
        No findings if all is consistent.
    """
    findings: list[Finding] = []
    comparisons: list[Comparison] = []
    if capture.cameras is None:
        # The views of a single viewpoint differ in their lights.
        chosen = _spread(list(range(capture.views.num_views)))
        cameras, views, truth = None, capture.views.take(chosen), _taken(capture.truth, chosen)
    else:
        subject = _subject(capture, capture.cameras)
        findings += _invalid(subject.cameras)
        if any(one.name == "cameras_not_finite" for one in findings):
            return CheckReport(findings=tuple(findings), comparisons=())
        subject = _check_cameras(subject, findings, comparisons)
        cameras, views, truth = subject.cameras, subject.views, subject.truth
        check_mesh(truth, cameras, findings, comparisons)
    check_normals(views, truth, cameras, findings, comparisons)
    check_lights(views, truth, cameras, findings, comparisons)
    return CheckReport(findings=tuple(findings), comparisons=tuple(comparisons))


def require_consistent(capture: Capture, *, warn: bool = False) -> None:
    """Refuse a capture in which :func:`check_capture` finds a mistake.

    Args:
        capture: To check.
        warn: Give a :class:`~pimper_torch.errors.PimperWarning` instead.

    Raises:
        InputError: Names the mistakes with their scores and what to do.
    """
    report = check_capture(capture)
    if not report.findings:
        return
    if warn:
        warnings.warn(PimperWarning(str(report)), stacklevel=2)
    else:
        raise InputError(str(report))


def _check_cameras(
    subject: _Subject, findings: list[Finding], comparisons: list[Comparison]
) -> _Subject:
    """Add findings on the cameras; give the subject with corrected cameras."""
    tests = _camera_tests(subject)
    if not tests:
        return subject
    mistakes = camera_mistakes(subject.cameras)
    candidates = [subject.cameras, *(mistake.undo(subject.cameras) for mistake in mistakes)]
    names = ("as given", *(mistake.name for mistake in mistakes))
    scores = {test: [score(cameras) for cameras in candidates] for test, score in tests.items()}
    comparisons += [
        Comparison(evidence=test, hypotheses=names, scores=tuple(values))
        for test, values in scores.items()
    ]
    total = np.mean(list(scores.values()), axis=0)
    best = int(total.argmax())
    if _clearly_better(float(total[best]), float(total[0])):
        mistake = mistakes[best - 1]
        near = [
            name for name, value in zip(names, total, strict=True) if value > total[best] - _TIE
        ]
        alternatives = tuple(name for name in near if name != mistake.name)
        findings.append(_named(mistake, scores, best, alternatives))
        return replace(subject, cameras=candidates[best])
    geometric = [values[0] for test, values in scores.items() if test != "features"]
    if geometric and max(geometric) < _HOPELESS:
        findings.append(
            Finding(
                name="cameras_unexplained",
                meaning="cameras and photographs do not belong together, and no common mistake "
                "explains it",
                remedy="check that names, order, units and the world frame are those of this set",
                evidence={test: values[0] for test, values in scores.items()},
            )
        )
        return subject
    shifted = _half_pixel(subject, findings, comparisons)
    return replace(subject, cameras=shifted)


def _clearly_better(best: float, given: float) -> bool:
    halved = 1 - best < _LEFT * (1 - given) and best > given + _MARGIN
    return halved or (best > _TIMES * given and best > given + _STEP)


def _camera_tests(subject: _Subject) -> dict[str, Callable[[Cameras], float]]:
    """List the tests that this capture allows."""
    tests: dict[str, Callable[[Cameras], float]] = {}
    masks, depth = subject.masks, subject.truth.depth
    points = _surface_points(subject.truth)
    many = subject.cameras.num_views > 1
    mesh = subject.truth.mesh
    if mesh is not None and len(mesh.faces) and masks is not None:
        caster = RayCaster(mesh.vertices_world, mesh.faces)
        tests["silhouettes"] = lambda cameras: silhouette_overlap(cameras, caster, masks)
    elif points is not None:
        points = points.to(subject.cameras.intrinsics)
        tests["points"] = lambda cameras: points_in_sight(cameras, points, masks)
    if depth is not None and many:
        tests["depth"] = lambda cameras: depth_agreement(cameras, depth)
    if masks is not None and subject.cameras.num_views > 2:
        tests["masks"] = lambda cameras: silhouette_coherence(cameras, masks)
    if many and "depth" not in tests and masks is None:
        matches = match_features(subject.views.images, subject.cameras)
        if sum(len(first) for first, _ in matches.values()) >= 8 * len(matches) > 0:
            tests["features"] = lambda cameras: epipolar_agreement(cameras, matches)
    return tests


def _named(
    mistake: CameraMistake, scores: dict[str, list[float]], best: int, alternatives: tuple[str, ...]
) -> Finding:
    evidence = {f"{test}, as given": values[0] for test, values in scores.items()}
    evidence |= {f"{test}, set right": values[best] for test, values in scores.items()}
    return Finding(
        name=mistake.name,
        meaning=mistake.meaning,
        remedy=mistake.remedy,
        evidence=evidence,
        alternatives=alternatives,
    )


def _half_pixel(
    subject: _Subject, findings: list[Finding], comparisons: list[Comparison]
) -> Cameras:
    """Test by the mesh's silhouette whether pixels are counted from centres or from corners."""
    mesh, masks = subject.truth.mesh, subject.masks
    if mesh is None or masks is None or len(mesh.faces) == 0:
        return subject.cameras
    shifts = {"as given": 0.0, "pixels_counted_from_centers": 0.5, "half_pixel_twice": -0.5}
    candidates = [_moved(subject.cameras, shift) for shift in shifts.values()]
    looked_at = sorted({0, subject.cameras.num_views - 1})
    off = [
        float(
            np.mean(
                [
                    silhouette_mismatch(cameras, mesh, masks, view, subject.truth.surroundings)
                    for view in looked_at
                ]
            )
        )
        for cameras in candidates
    ]
    comparisons.append(
        Comparison(
            evidence="silhouettes",
            hypotheses=tuple(shifts),
            scores=tuple(max(0.0, 1 - value) for value in off),
        )
    )
    best = int(np.argmin(off))
    if not (off[0] > 0.2 and off[best] < 0.5 * off[0]):
        return subject.cameras
    added = list(shifts.values())[best]
    findings.append(
        Finding(
            name=list(shifts)[best],
            meaning="the principal point is half a pixel off: the centre of the top-left pixel is "
            "(0.5, 0.5) here",
            remedy=f"add {added:g} to cx and cy",
            evidence={"silhouette off, as given": off[0], "silhouette off, set right": off[best]},
        )
    )
    return candidates[best]


def _moved(cameras: Cameras, shift: float) -> Cameras:
    moved = cameras.intrinsics.clone()
    moved[:, :2, 2] += shift
    return cameras.replace(intrinsics=moved)


def _invalid(cameras: Cameras) -> list[Finding]:
    """Find cameras that are not finite, or not rigid."""
    if not bool(cameras.intrinsics.isfinite().all() & cameras.cam_from_world.isfinite().all()):
        return [
            Finding(
                name="cameras_not_finite",
                meaning="some cameras are not finite",
                remedy="leave out the photographs without a camera",
                evidence={},
            )
        ]
    rotation = cameras.cam_from_world[:, :3, :3].double()
    gram = rotation @ rotation.mT - torch.eye(3).to(rotation)
    off = float(gram.abs().max())
    if off <= _NOT_RIGID:
        return []
    return [
        Finding(
            name="not_rigid",
            meaning="rotations are not orthogonal: scale or shear is mixed in, or the matrix is "
            "K [R | t]",
            remedy="split the projection into K and a rotation, or divide by the scale",
            evidence={"largest entry of R R^T - I": off},
        )
    ]


def _subject(capture: Capture, cameras: Cameras) -> _Subject:
    first: dict[int, int] = {}
    for view, position in enumerate(capture.position.tolist()):
        first.setdefault(position, view)
    chosen = _spread(list(first.values()))
    views, truth = capture.views.take(chosen), _taken(capture.truth, chosen)
    masks = views.masks if views.masks is not None else truth.foreground
    if masks is not None:
        drawn = masks[views.inside].float().mean()
        masks = masks & views.inside if 0 < float(drawn) < _WHOLE else None
    return _Subject(views=views, cameras=cameras.take(chosen), truth=truth, masks=masks)


def _spread(views: list[int]) -> list[int]:
    """Pick pairs of successive views all along; successive ones show most in common."""
    if len(views) <= _MAX_VIEWS:
        return views
    starts = np.linspace(0, len(views) - 2, _MAX_VIEWS // 2).round().astype(int)
    return [views[index] for start in starts for index in (start, start + 1)]


def _taken(truth: Truth, chosen: list[int]) -> Truth:
    maps = ("depth", "normals_world", "albedo", "foreground", "lit", "highlight")
    fields = {name: getattr(truth, name) for name in (*maps, "lights_world", "point_lights_world")}
    known = {name: values[chosen] for name, values in fields.items() if values is not None}
    return truth.replace(**known)


def _surface_points(truth: Truth) -> Float[Tensor, "point 3"] | None:
    """Draw points of the true mesh or cloud; ``None`` without either."""
    mesh = truth.mesh
    if mesh is None and truth.points_world is not None:
        mesh = Mesh(vertices_world=truth.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    if mesh is None or len(mesh.vertices_world) == 0:
        return None
    return sample_surface(mesh, _MAX_POINTS, torch.Generator().manual_seed(0)).points
