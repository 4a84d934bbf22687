"""What a page says of every photograph: its camera, its picture, its light."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.report.pictures import jpeg, longest_px, outline, shrunk

Json = dict[str, object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """A photograph as the surface explains it.

    Attributes:
        radiance: Linear, under the photograph's fitted light; zero off the surface.
        direction: Towards the light, unit, world frame.
        directed: Radiance that the light adds to albedo 1 facing it, a channel.
        ambient: The same of light from all around.
        figure: What the prediction is worth, in a few words.
    """

    radiance: Float[Tensor, "channel height width"]
    direction: Float[Tensor, " 3"]
    directed: Float[Tensor, " channel"]
    ambient: Float[Tensor, " channel"]
    figure: str


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
    return entries


def _prediction(predicted: Prediction, longest: int) -> Json:
    light = {
        "direction": predicted.direction.tolist(),
        "directed": _three(predicted.directed),
        "ambient": _three(predicted.ambient),
    }
    picture = jpeg(shrunk(predicted.radiance, longest))
    return {"light": light, "prediction": picture, "figure": predicted.figure}


def _three(values: Float[Tensor, " channel"]) -> list[float]:
    return values.detach().cpu().double().expand(3).tolist()
