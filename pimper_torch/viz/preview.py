"""A first look at a run: the coarse surface, beside the photograph that it is seen from."""

from pathlib import Path

import torch
from PIL import Image
from torch.nn.functional import interpolate

from pimper_torch.radiometry import to_bytes
from pimper_torch.records import CoarseMesh, SparseScene
from pimper_torch.viz.render import frame, rotation, shade

_SIDES_DEG = (0.0, -40.0, 40.0)


@torch.no_grad()
def draw_preview(
    scene: SparseScene, coarse: CoarseMesh, path: Path | str, panel_px: int = 360
) -> None:
    """Draw the reference photograph, and the coarse surface from there, left and right, as PNG.

    Args:
        path: A former file is replaced when the new one is complete.
        panel_px: Longer side of a picture of the surface, and height of the photograph.
    """
    path = Path(path)
    own = scene.cameras.take([coarse.reference]).to("cpu")
    mesh = coarse.mesh.to("cpu")
    width, height = own.sizes_px[0].tolist()
    image = scene.views.images[coarse.reference, :, :height, :width].cpu()[None]
    size = (panel_px, max(1, round(panel_px * width / height)))
    photograph = interpolate(image, size=size, mode="area")[0].movedim(0, -1)
    center = mesh.vertices_world.mean(dim=0)
    panels = [Image.fromarray(to_bytes(photograph.expand(*size, 3)).numpy())]
    for angle in _SIDES_DEG:
        camera = frame(rotation(own, center, angle), mesh.vertices_world, panel_px, 0.05)
        drawn = (255 * shade(mesh, camera)).round().to(torch.uint8)
        panels.append(Image.fromarray(drawn.numpy()))
    sheet = Image.new("RGB", (sum(one.width for one in panels), panel_px), "white")
    left = 0
    for panel in panels:
        sheet.paste(panel, (left, (panel_px - panel.height) // 2))
        left += panel.width
    fresh = path.with_name(f"{path.name}.new")
    sheet.save(fresh, format="PNG")
    fresh.replace(path)
