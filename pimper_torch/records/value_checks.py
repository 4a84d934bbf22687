"""Checks of the values of a record, once for each tensor."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from pimper_torch.records.shapes import Vectors

_passed: Any = WeakIdKeyDictionary()  # by tensor: its passed checks; torch does not type it

Faults = Iterator[tuple[str, str, str]]
"""Invalid values of a record: the field, the value found, the value needed."""


def faults_in(
    field: str, needed: str, test: Callable[..., str], tensor: Tensor, *context: object
) -> Faults:
    """List the fault that ``test(tensor, *context)`` finds in the values of a field.

    Args:
        test: Returns a description of the fault; empty if there is none.
        tensor: Not checked again once it passed, even if it was written into since.
        context: Further arguments of ``test``, such as a number of vertices or a mask.
    """
    key = (test, *(id(item) if isinstance(item, Tensor) else item for item in context))
    passed = _passed.setdefault(tensor, set())
    if key in passed:
        return
    with torch.no_grad():
        found = test(tensor, *context)
    if found:
        yield field, found, needed
    else:
        passed.add(key)


def faults_of_names(names: Sequence[str], count: int, what: str) -> Faults:
    """List a fault unless ``names`` are ``count`` different names."""
    if len(names) != count or len(set(names)) < len(names):
        found = f"has {len(names)} entries, {len(set(names))} of which are different"
        yield "names", found, f"a unique name for each of {count} {what}"


def out_of_range(index: Int[Tensor, "..."], count: int) -> str:
    """Return the range of indices if it exceeds ``count`` entries."""
    if index.numel() == 0:
        return ""
    low, high = (int(value) for value in index.aminmax())
    return f"range from {low} to {high}" if low < 0 or high >= count else ""


def not_finite(values: Float[Tensor, "..."], where: Bool[Tensor, "..."] | None = None) -> str:
    """Return how many values are NaN or infinite."""
    if values.numel() == 0 or bool(torch.stack(values.aminmax()).isfinite().all()):
        return ""
    bad = ~values.isfinite()
    if where is not None:
        bad = bad & where.reshape(where.shape + (1,) * (bad.ndim - where.ndim))
    count = int(bad.sum())
    return f"has {count} of {values.numel()} values that are not finite" if count else ""


def outside(values: Float[Tensor, "..."], high: float) -> str:
    """Return how many values are not finite, below 0 or above ``high``."""
    rounding = 1e-5
    bad = ~((values >= -rounding) & (values <= high + rounding) & values.isfinite())
    count = int(bad.sum())
    if count == 0:
        return ""
    fraction = f"{count} of {values.numel()} values outside [0, {high:g}]"
    return f"has {fraction}, such as {float(values[bad][0]):.4g}"


def not_unit(normals: Vectors, where: Bool[Tensor, "*batch"] | None) -> str:
    """Return how many normals are not of unit length, and a likely cause."""
    length = normals.norm(dim=-1)
    bad = ~((length - 1).abs() <= 0.02)  # also true for NaN; components of 8 bits are 0.4 % off
    if where is not None:
        bad = bad & where
    count = int(bad.sum())
    if count == 0:
        return ""
    invalid = normals[bad]
    if not bool(invalid.isfinite().all()):
        return f"has {count} of {bad.numel()} normals that are not unit, some with NaN"
    coded = bool((invalid >= 0).all() and (invalid <= 1).all()) and count > 1
    hint = "; they look like colours from 0 to 1: decode them as 2 n - 1" if coded else ""
    return (
        f"has {count} of {bad.numel()} normals that are not unit, of length "
        f"{float(length[bad].min()):.3g} to {float(length[bad].max()):.3g}{hint}"
    )


def not_above_zero(variance: Float[Tensor, "..."]) -> str:
    """Return how many variances are not above 0."""
    count = int((~(variance > 0)).sum())
    return f"has {count} of {variance.numel()} values that are not above 0" if count else ""


def facing_away(normals: Vectors, where: Bool[Tensor, "*batch"]) -> str:
    """Return how many normals of patches face away from the viewer."""
    away = where & (normals[..., 2] >= 0)
    count, among = int(away.sum()), int(where.sum())
    if count == 0:
        return ""
    opengl = (
        "; they look like OpenGL's, with y up and z to the viewer: negate both"
        if count > 0.9 * among
        else ""
    )
    return f"has {count} of {among} valid normals that face away{opengl}"


def not_rigid(cam_from_world: Float[Tensor, "view 4 4"]) -> str:
    """Return how many matrices are not a rotation and a translation, and the first of them."""
    rotation = cam_from_world[:, :3, :3].double()
    eye = torch.eye(3, dtype=torch.float64, device=rotation.device)
    off = (rotation @ rotation.mT - eye).abs().amax(dim=(1, 2))
    last = cam_from_world.new_tensor([0.0, 0.0, 0.0, 1.0])
    bad = ~(off <= 1e-3) | (cam_from_world[:, 3] != last).any(dim=1)
    mirrored = torch.linalg.det(rotation) < 0
    if bool((mirrored & ~bad).any()):
        return f"has {int(mirrored.sum())} matrices that mirror (determinant -1)"
    if not bool(bad.any()):
        return ""
    view = int(bad.nonzero()[0, 0])
    return (
        f"has {int(bad.sum())} of {len(bad)} matrices that are not rigid, the first of view {view} "
        f"(rows off by {float(off[view]):.2g}, last row {cam_from_world[view, 3].tolist()})"
    )


def not_pinhole(intrinsics: Float[Tensor, "view 3 3"]) -> str:
    """Return how many matrices are not a pinhole's ``K``, and the first of them."""
    last = intrinsics.new_tensor([0.0, 0.0, 1.0])
    focal = intrinsics.diagonal(dim1=1, dim2=2)[:, :2]
    bad = ~(focal > 0).all(dim=1) | (intrinsics[:, 2] != last).any(dim=1)
    bad |= intrinsics[:, 1, 0] != 0
    if not bool(bad.any()):
        return ""
    view = int(bad.nonzero()[0, 0])
    return f"has {int(bad.sum())} matrices that are not K, the first {intrinsics[view].tolist()}"


def mean(values: Tensor) -> float:
    """Return the mean, or 0 of no values."""
    return float(values.mean()) if len(values) else 0.0
