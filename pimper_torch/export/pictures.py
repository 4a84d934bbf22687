"""Images of a finished result, which depend neither on formats nor on the unit of length."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

from pimper_torch.chains.running import ChainRun
from pimper_torch.geometry.visibility import visible_vertices
from pimper_torch.records import FinishedMesh, Reconstruction, Record, Relighting, TexturedMesh
from pimper_torch.records.shapes import PerVertex, VertexMask
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.scale.marker_scale import Marker, find_markers
from pimper_torch.stages.sfm.sparse_scene import point_colors
from pimper_torch.stages.stage import Stage
from pimper_torch.store import Store
from pimper_torch.viz.overview import draw_overview
from pimper_torch.viz.report.openness import openness
from pimper_torch.viz.report.predictions import predictions, view_images
from pimper_torch.viz.turn import draw_turn


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pictures(Record):
    """Images of a surface and its photographs.

    Attributes:
        overview: Bytes of ``overview.png``.
        turn: Bytes of ``turn.webp``.
        openness: Of the asset's vertices.
        seen: Whether a photograph shows each of them.
        views: JSON of :func:`~pimper_torch.viz.report.predictions.view_images`.
        points: Colours of the sparse cloud.
        markers: Printed ones in the photographs.
    """

    overview: UInt8[Tensor, " overview"]
    turn: UInt8[Tensor, " turn"]
    openness: PerVertex
    seen: VertexMask
    views: str
    points: UInt8[Tensor, "point 3"]
    markers: tuple[Marker, ...]


class Draw(Stage):
    """Draw the images of a finished result."""

    kept_as = Pictures

    def forward(self, result: Reconstruction) -> Pictures:
        """Draw the surface, the photographs and their predictions."""
        release_memory()  # of the full mesh's caster
        ready, asset, relighting = completed(result)
        scene, masks, turn, overview = result.scene, result.silhouettes, BytesIO(), BytesIO()
        calls: tuple[Callable[[], Any], ...] = (
            lambda: draw_turn(result.mesh, result.cameras, result.coarse.reference, turn),
            lambda: view_images(scene, masks, predictions(ready.few, scene, relighting)),
            lambda: draw_overview(result, overview),
            lambda: openness(asset.mesh),
            lambda: visible_vertices(asset.mesh, result.cameras).any(dim=0),
            lambda: point_colors(scene),
            lambda: tuple(find_markers(scene)),
        )
        _, views, _, opens, seen, points, markers = side_by_side(lambda call: call(), calls)
        return Pictures(
            overview=torch.frombuffer(overview.getbuffer(), dtype=torch.uint8),
            turn=torch.frombuffer(turn.getbuffer(), dtype=torch.uint8),
            openness=opens,
            seen=seen,
            views=json.dumps(views),
            points=points,
            markers=markers,
        )


def drawn(result: Reconstruction, store: Store | None = None) -> Pictures:
    """Draw the images of a finished result, or read those that a store keeps."""
    ready, draw = completed(result)[0], Draw()
    # Without what they do not show: the full mesh, caps and times.
    shown = result.replace(mesh=ready.mesh, report=(), failures=(), left_out=())
    shown = shown.replace(finished=ready.replace(closed=None, caps={}))
    return ChainRun(names={draw: "draw"}, store=store)(draw, shown)


def completed(result: Reconstruction) -> tuple[FinishedMesh, TexturedMesh, Relighting]:
    """Return what :meth:`~pimper_torch.chains.chain.Chain.finish` added to a result."""
    ready, asset, relighting = result.finished, result.asset, result.relighting
    assert ready is not None
    assert asset is not None
    assert relighting is not None
    return ready, asset, relighting
