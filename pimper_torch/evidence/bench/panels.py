"""Pictures of the table: each method's surface, and its errors along the rays of a view."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.bench.inputs import Inputs
from pimper_torch.evidence.metrics.distances import bounding_diagonal
from pimper_torch.evidence.metrics.relative import Meeting
from pimper_torch.records import Capture, Mesh
from pimper_torch.viz.heatmap import (
    ErrorScale,
    MethodPanels,
    SceneRow,
    crop_to,
    draw_heatmap,
    error_picture,
    normals_picture,
    shading_in_view,
    surface_picture,
)
from pimper_torch.viz.tiles import encoded

# Per cent of the diagonal: twice what the facets alone are off by, so that methods differ.
ERROR_SCALE = ErrorScale(clip=1.0, unit="% of the diagonal")


def method_panels(
    mesh: Mesh, met: Meeting | None, inputs: Inputs, scene: str, method: str, heatmap: Path
) -> MethodPanels:
    """Draw the errors of a surface on it, and give its pictures for the sheet.

    Args:
        mesh: In the frame of the truth.
        met: Where the rays of the reference view meet it; ``None`` if none does.
    """
    truth = inputs.maps
    if met is None or truth.cameras is None:
        return MethodPanels(method=method, note="points only")
    errors = error_along_rays(met, truth)
    shading = shading_in_view(mesh, truth.cameras, 0)
    draw_heatmap(errors, ERROR_SCALE, heatmap, shading=shading, title=f"{scene}, {method}")
    crop = _crop(truth)
    return MethodPanels(
        method=method,
        surface=surface_picture(mesh, truth.cameras, 0, met.hits)[crop],
        error=error_picture(errors, ERROR_SCALE, shading=shading)[crop],
    )


def scene_row(scene: str, inputs: Inputs, methods: tuple[MethodPanels, ...]) -> SceneRow:
    """Return a scene's row: photograph, truth, and the panels of all methods."""
    maps = inputs.maps
    assert maps.cameras is not None
    assert maps.truth.normals_world is not None
    crop = _crop(maps)
    taken = inputs.scene.views.images[inputs.coarse.reference]
    return SceneRow(
        scene=scene,
        photograph=encoded(taken.movedim(0, -1))[crop],
        truth=normals_picture(maps.truth.normals_world[0], maps.cameras, 0)[crop],
        methods=methods,
    )


def error_along_rays(met: Meeting, capture: Capture) -> Float[Tensor, "height width"]:
    """Return the distance of a surface from the truth along the rays of a view.

    Returns:
        Per cent of the diagonal of the true bounding box; infinite on the object where the
        surface is missed, NaN off the object.
    """
    assert capture.truth.mesh is not None
    error = torch.full(met.valid.shape, torch.nan, dtype=torch.float64)
    error[met.valid] = torch.inf
    distance = (met.points - met.points_true).norm(dim=-1).double()
    error[met.both] = 100 * distance / bounding_diagonal(capture.truth.mesh)
    return error


def _crop(maps: Capture) -> tuple[slice, slice]:
    assert maps.truth.foreground is not None
    return crop_to(maps.truth.foreground[0])
