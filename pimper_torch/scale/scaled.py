"""Conversion of a result to a different unit of length."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from torch import Tensor

import pimper_torch.records as records
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Record
from pimper_torch.runtime.config import require
from pimper_torch.runtime.events import Event

AnyRecord = TypeVar("AnyRecord", bound=Record)

POWERS: Mapping[type[Record], Mapping[str, int]] = {
    records.Mesh: {"vertices_world": 1, "expected_error": 1},
    records.CoarseMesh: {"covariance_world": 2},
    records.FacetPoints: {"points_world": 1, "covariance_world": 2},
    records.SparseScene: {"points_world": 1},
    records.Templates: {"origin": 1, "spacing": 1, "depth": 1},
    records.Depths: {"depth": 1},
    records.DepthPatches: {"mismatch": 1},
    records.Heights: {"offset": 1, "information": -2},
    records.PatchPriors: {"offset": 1, "offset_information": -2},
    records.DepthPrior: {"depth": 1, "variance": 2},
    records.Surface: {"vertices_world": 1, "expected_error": 1, "height_information": -2},
}
"""Power of length of each field; other fields have no unit, or contain records."""

POSES: Mapping[type[Record], str] = {
    records.Cameras: "cam_from_world",
    records.Templates: "patch_from_world",
}
"""Rigid transforms; their translation is a length."""

LAST: Mapping[type[Record], str] = {
    records.Depths: "transform",
    records.Silhouettes: "planes_world",
}
"""Vectors; only their last entry is a length."""

# Figures of stages in scene units.
_FIGURES = ("mismatch", "mismatch_before")


def scaled(record: AnyRecord, factor: float) -> AnyRecord:
    """Return a result, or a record of it, with every length multiplied by a factor.

    This includes vertices, expected errors, cameras, cloud, templates and their heights,
    covariances and inverse variances, the supporting plane, and ``offset_world``. Photographs,
    normals, albedo and lights have no unit and are shared with ``record``. Fields that share an
    object still share it. Differentiable in the record's tensors.

    Args:
        record: Of a run, such as a :class:`~pimper_torch.records.Reconstruction`.
        factor: Ratio of numbers in the new unit to those in the old unit.

    >>> import torch
    >>> from pimper_torch.records import Mesh
    >>> square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    >>> scaled(Mesh(vertices_world=square, faces=torch.tensor([[0, 1, 2]])), 25.4).vertices_world
    tensor([[ 0.0000,  0.0000,  0.0000],
            [25.4000,  0.0000,  0.0000],
            [25.4000, 25.4000,  0.0000]])
    """
    require(0 < factor < float("inf"), "factor", factor, "above 0 and finite")
    converted: AnyRecord = record if factor == 1 else _copy(record, factor, {})
    return converted


def _copy(value: Any, factor: float, copies: dict[int, Any]) -> Any:  # noqa: ANN401 - of any field
    """Scale the value of a field; each object is copied once."""
    if isinstance(value, records.StageReport):
        lengths = {name: factor * value.figures[name] for name in _FIGURES if name in value.figures}
        return value.replace(figures=value.figures | lengths) if lengths else value
    if isinstance(value, tuple) and any(isinstance(item, Record | Event) for item in value):
        return tuple(_copy(item, factor, copies) for item in value)
    if not isinstance(value, Record):
        return value
    if id(value) in copies:
        return copies[id(value)]
    record, kind, changes = value, type(value), dict[str, object]()
    for field in fields(record):
        value = getattr(record, field.name)
        new = _copy(value, factor, copies)
        if isinstance(value, Tensor):
            if power := POWERS.get(kind, {}).get(field.name):
                new = value * factor**power
            elif POSES.get(kind) == field.name:
                new = rigid(value[..., :3, :3], factor * value[..., :3, 3])
            elif LAST.get(kind) == field.name:
                new = value * value.new_tensor([1.0, 1.0, 1.0, factor])
        if new is not value:
            changes[field.name] = new
    if isinstance(record, records.FinishedMesh) and "spacing" in record.counts:
        changes["counts"] = record.counts | {"spacing": factor * record.counts["spacing"]}
    if isinstance(record, records.SparseScene):
        changes["offset_world"] = tuple(factor * length for length in record.offset_world)
    return copies.setdefault(id(record), record.replace(**changes) if changes else record)
