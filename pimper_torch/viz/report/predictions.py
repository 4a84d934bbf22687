"""Photographs and their predictions from the surface, small enough for a page."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.io.photographs import shrunk_size
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Mesh, Record, Relighting, Silhouettes, SparseScene, ViewLights
from pimper_torch.records.shapes import Map
from pimper_torch.runtime.mapped import drop_pages
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.relighting.held_out import predict
from pimper_torch.stages.relighting.lit_surface import LitSurface
from pimper_torch.viz.tiles import data_url

# The demo's 24 photographs and their predictions take 1.1 MB of its page; more photographs share
# this size. Fewer pixels than the minimum are not informative.
_LONGEST_PX, _SHORTEST_PX, _VIEWS = 800, 120, 24


def longest_px(num_views: int) -> int:
    """Return the longer side of every photograph in a page with ``num_views`` photographs."""
    return round(max(_SHORTEST_PX, _LONGEST_PX * min(1.0, math.sqrt(_VIEWS / num_views))))


def shrunk_to(
    image: Float[Tensor, "channel height width"], longest: int
) -> Float[Tensor, "channel shorter narrower"]:
    """Shrink an image by averaging until its longer side is ``longest`` pixels, if it is larger."""
    height, width = image.shape[-2:]
    return interpolate(image[None], size=shrunk_size(height, width, longest), mode="area")[0]


def jpeg(radiance: Float[Tensor, "channel height width"]) -> str:
    """Return an image of linear radiance, clipped at 1, as a data URL of a JPEG."""
    colors = to_bytes(radiance.detach().cpu().clamp(0, 1).movedim(0, -1)).expand(-1, -1, 3)
    return data_url(Image.fromarray(colors.numpy()))


def outline(inside: Map, scale: float) -> str:
    """Trace the border of a silhouette as an SVG path.

    Args:
        scale: Pixels of the photograph per pixel of ``inside``.
    """
    # Imported here because scipy's image functions are slow to import.
    from skimage.measure import approximate_polygon, find_contours

    values = inside.detach().float().cpu().numpy()
    lines = [approximate_polygon(line, 0.7) for line in find_contours(values, 0.5)]
    return "".join(
        "M" + "L".join(f"{scale * (x + 0.5):.0f} {scale * (y + 0.5):.0f}" for y, x in line)
        for line in lines
        if len(line) > 2
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Prediction(Record):
    """A photograph predicted from the surface.

    Attributes:
        radiance: Linear, under the photograph's fitted light; zero off the surface.
        psnr_db: NaN if the photograph was not evaluated.
    """

    radiance: Float[Tensor, "channel height width"]
    light: ViewLights
    psnr_db: float = math.nan


def predictions(mesh: Mesh, scene: SparseScene, relighting: Relighting) -> list[Prediction]:
    """Predict every photograph of a scene under its fitted light.

    Args:
        mesh: In the scene's frame, with albedo.
    """
    surface, errors = LitSurface(mesh), relighting.errors
    longest = longest_px(scene.views.num_views) // 2  # rays dominate the cost
    psnr_db = dict(zip(errors.names, errors.psnr_db.tolist(), strict=True))

    def of_view(view: int) -> Prediction:
        light, camera = relighting.lights.take([view]), scene.cameras.take([view])
        width, height = camera.sizes_px[0].tolist()
        sides = shrunk_size(width, height, longest)
        camera = camera.replace(
            intrinsics=scale_intrinsics(camera.intrinsics, sides[0] / width, sides[1] / height),
            sizes_px=torch.tensor([sides]),
        )
        image = predict(surface, camera, light, relighting.materials)
        radiance = image.nan_to_num(0).movedim(-1, 0)
        decibels = psnr_db.get(scene.views.names[view], math.nan)
        return Prediction(radiance=radiance, light=light, psnr_db=decibels)

    return list(side_by_side(of_view, range(scene.views.num_views), tracked=False))


Json = dict[str, object]


def view_images(
    scene: SparseScene, silhouettes: Silhouettes, predictions: Sequence[Prediction | None]
) -> list[Json]:
    """Return the images of every view, its silhouette and the light of its prediction, as JSON.

    They do not depend on the unit of length.

    Args:
        predictions: One per view, ``None`` without a prediction.
    """
    longest, entries = longest_px(scene.views.num_views), list[Json]()
    for view, predicted in enumerate(predictions):
        width, height = scene.views.sizes_px[view].tolist()
        image = scene.views.images[view, :, :height, :width]
        entry: Json = {"photo": jpeg(shrunk_to(image, longest))}
        if silhouettes.source != "everything":
            small = shrunk_to(silhouettes.inside[view, :height, :width][None], longest)[0]
            entry["outline"] = outline(small, width / small.shape[1])
        if predicted is not None:
            light = predicted.light
            entry["light"] = {
                "direction": light.direction_world[0].tolist(),
                "inverse_distance": float(light.inverse_distance[0]),
                "directed": light.directed[0].expand(3).tolist(),
                "ambient": light.ambient[0].expand(3).tolist(),
            }
            if not math.isnan(predicted.psnr_db):
                entry["psnr_db"] = predicted.psnr_db
            entry["prediction"] = jpeg(shrunk_to(predicted.radiance, longest))
        entries.append(entry)
        drop_pages()
    return entries


def view_entries(
    scene: SparseScene,
    silhouettes: Silhouettes,
    images: Sequence[Json],
    lights_world: Float[Tensor, "view 4"] | None = None,
) -> list[Json]:
    """Return the views with their pinholes and lights, as JSON.

    Args:
        images: By :func:`view_images`.
        lights_world: First-order light of every view, up to a scale; NaN where unknown.
    """
    cameras, entries = scene.cameras.to("cpu"), list[Json]()
    for view, (name, shown) in enumerate(zip(scene.views.names, images, strict=True)):
        width, height = cameras.sizes_px[view].tolist()
        intrinsics = cameras.intrinsics[view]
        entry: Json = {
            "name": name,
            "width": width,
            "height": height,
            "focal": [float(intrinsics[0, 0]), float(intrinsics[1, 1])],
            "centre": [float(intrinsics[0, 2]), float(intrinsics[1, 2])],
            "pose": cameras.cam_from_world[view].double().flatten().tolist(),
            "reliable": bool(silhouettes.reliable[view]),
            **shown,
        }
        if lights_world is not None and bool(lights_world[view].isfinite().all()):
            entry["environment"] = lights_world[view].tolist()
        entries.append(entry)
    return entries
