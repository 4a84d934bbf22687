"""How an estimate is laid on the truth before it is measured, and what that did to it."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.evidence.metrics.distances import true_surface
from pimper_torch.evidence.metrics.icp import IcpConfig, trimmed_icp
from pimper_torch.evidence.metrics.similarity import (
    pair_views,
    rotation_angles_deg,
    similarity_between_cameras,
    split_similarity,
)
from pimper_torch.evidence.metrics.visible import joined
from pimper_torch.geometry.frames import transform
from pimper_torch.records import Cameras, Capture, Estimate, Mesh, Record

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
            surfaces, see :func:`pimper_torch.evidence.metrics.icp.trimmed_icp`. ``auto`` is
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
