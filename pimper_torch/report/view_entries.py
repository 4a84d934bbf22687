"""Entries of a page for every photograph: its camera, its picture, its light."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from pimper_torch.mapped import drop_pages
from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.relighting.fit_lights import ViewLights
from pimper_torch.report.page_pictures import jpeg, longest_px, outline, shrunk
from pimper_torch.report.predictions import Prediction

Json = dict[str, object]


def view_entries(
    scene: SparseScene,
    silhouettes: Silhouettes,
    predictions: Sequence[Prediction | None],
) -> list[Json]:
    """List the photographs with their pinholes, pictures, silhouettes and lights.

    Args:
        predictions: One a view, ``None`` where there is none.
    """
    longest = longest_px(scene.views.num_views)
    cameras, entries = scene.cameras.to("cpu"), []
    for view, (name, predicted) in enumerate(zip(scene.views.names, predictions, strict=True)):
        width, height = (int(side) for side in cameras.sizes_px[view])
        intrinsics = cameras.intrinsics[view]
        entry: Json = {
            "name": name,
            "width": width,
            "height": height,
            "focal": [float(intrinsics[0, 0]), float(intrinsics[1, 1])],
            "centre": [float(intrinsics[0, 2]), float(intrinsics[1, 2])],
            "pose": cameras.cam_from_world[view].double().flatten().tolist(),
            "reliable": bool(silhouettes.reliable[view]),
            "photo": jpeg(shrunk(scene.views.images[view, :, :height, :width], longest)),
        }
        if silhouettes.source != "everything":
            small = shrunk(silhouettes.inside[view, :height, :width][None], longest)[0]
            entry["outline"] = outline(small, width / small.shape[1])
        entries.append(entry | ({} if predicted is None else _prediction(predicted, longest)))
        drop_pages()
    return entries


def _prediction(predicted: Prediction, longest: int) -> Json:
    picture = jpeg(shrunk(predicted.radiance, longest))
    return {"light": _light(predicted.light), "prediction": picture, "figure": predicted.figure}


def _light(light: ViewLights) -> Json:
    return {
        "direction": light.direction_world[0].tolist(),
        "closeness": float(light.closeness[0]),
        "directed": _three(light.directed[0]),
        "ambient": _three(light.ambient[0]),
    }


def _three(values: Float[Tensor, " channel"]) -> list[float]:
    return values.expand(3).tolist()
