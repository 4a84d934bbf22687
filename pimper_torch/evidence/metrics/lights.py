"""How far the lights of an estimate point from the true ones."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.evidence.metrics.relative import angles_deg
from pimper_torch.evidence.metrics.similarity import nearest_rotation, rotation_angles_deg
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFigures(Record):
    """Angles between the directions of lights, in degrees.

    Attributes:
        mean_deg: In the frame of the truth, after the estimate was aligned.
        mean_rotated_deg: Up to the one rotation of all lights that brings them nearest.
        lights: How many have a direction in both.
    """

    mean_deg: float
    median_deg: float
    mean_rotated_deg: float
    median_rotated_deg: float
    rotation_deg: float
    lights: int


def compare_lights(
    lights: Float[Tensor, "view 4"],
    lights_true: Float[Tensor, "view 4"],
    rotation: Float[Tensor, "3 3"],
) -> LightFigures | None:
    """Compare the directions of first-order lights, as they are and up to a rotation.

    Uncalibrated methods leave a rotation of all lights and normals together open, and normals
    are often compared after it; both figures are given. The rotation minimises the summed
    squares of the distances between unit directions. Two lights or fewer, or lights in a
    plane with the origin, are brought nearer by it than they deserve.

    Args:
        lights: World frame of the estimate; rows that are zero or not finite are unknown.
        rotation: From the estimate's frame to that of the truth.

    Returns:
        ``None`` if no view has a direction in both.

    Source: Kabsch, Acta Crystallographica A32(5), 1976.
    """
    ours = lights[:, 1:].cpu().double() @ rotation.cpu().double().mT
    truth = lights_true[:, 1:].cpu().double()
    known = (ours.norm(dim=1) > 0) & (truth.norm(dim=1) > 0)
    known &= ours.isfinite().all(dim=1) & truth.isfinite().all(dim=1)
    if not bool(known.any()):
        return None
    ours, truth = normalize(ours[known], dim=1), normalize(truth[known], dim=1)
    joint = nearest_rotation(truth.mT @ ours)
    plain, rotated = angles_deg(ours, truth), angles_deg(ours @ joint.mT, truth)
    return LightFigures(
        mean_deg=float(plain.mean()),
        median_deg=float(plain.median()),
        mean_rotated_deg=float(rotated.mean()),
        median_rotated_deg=float(rotated.median()),
        rotation_deg=float(rotation_angles_deg(joint)),
        lights=int(known.sum()),
    )
