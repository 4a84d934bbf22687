"""Draw the pictures of the documentation: ``python docs/pictures.py [captures] [stages]``.

Captures are sheets of photographs that ``pimper render`` makes; each stands in
``docs/photographs.md`` under its command. Stages are drawn from the bundled skull.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from PIL import Image

import pimper_torch as pt
from pimper_torch.cli.options import bundled_photographs
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.render import bounding_box, frame, shade

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
CAPTURE = re.compile(r"^    pimper render (.+) -o ([\w-]+)$", flags=re.MULTILINE)

# Of a sheet: photographs side by side, and the width of each.
COLUMNS, WIDTH_PX, GAP_PX = 4, 236, 4

# Of the pictures of stages: the longer side of a panel, the photograph that they look from, and
# room round the object.
PANEL_PX, REFERENCE, MARGIN = 320, "37", 0.02

# The files stay below 80 kB.
QUALITY = 82


def draw_captures() -> None:
    """Render the captures that the page names, a sheet each."""
    page = (DOCS / "photographs.md").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        for options, name in CAPTURE.findall(page):
            scene = Path(folder) / name
            subprocess.run(["pimper", "render", *options.split(), "-o", str(scene)], check=True)
            photographs = sorted((scene / "photos").iterdir())
            every = max(1, len(photographs) // COLUMNS)
            chosen = [Image.open(path) for path in photographs[::every][:COLUMNS]]
            sheet([image.convert("RGB") for image in chosen], WIDTH_PX).save(
                IMAGES / f"{name}.jpg", quality=QUALITY
            )


def draw_stages() -> None:
    """Reconstruct the bundled skull, and draw what the stages of every pass give."""
    views = pt.load_views(bundled_photographs())
    chain = pt.load_chain("default", {"coarse_surface": {"reference": REFERENCE}})
    passes: list[Image.Image] = []
    for step in chain.steps(views):
        view = step.coarse.reference
        camera = step.scene.cameras.take([view])
        surface = Mesh(vertices_world=step.surface.vertices_world, faces=step.surface.faces)
        around = frame(camera, step.coarse.mesh.vertices_world, PANEL_PX, MARGIN)
        if not passes:
            low, high = bounding_box(camera, step.coarse.mesh.vertices_world, MARGIN)
            corners = int(low[0]), int(low[1]), int(high[0]), int(high[1])
            shown = [
                photograph(step.scene.views, view).crop(corners),
                silhouette(step, view).crop(corners),
                picture(shade(step.coarse.mesh, around, flat=True)),
                normals(step.coarse.mesh, around),
            ]
            sheet(shown, PANEL_PX).save(IMAGES / "stages.jpg", quality=QUALITY)
        if step.last:
            pt.plot_patch(step.heights[largest(step)]).savefig(IMAGES / "patch.png", dpi=70)
        passes += [normals(surface, around), picture(shade(surface, around))]
    sheet(passes[::2] + passes[1::2], PANEL_PX, 3).save(IMAGES / "passes.jpg", quality=QUALITY)


def largest(step: pt.Step) -> int:
    """Find the facet of most samples with a photometric normal."""
    count, facet = 0, 0
    for templates, bucket in zip(step.patches.buckets, step.photometric.buckets, strict=True):
        valid = bucket.valid.flatten(1).sum(dim=1)
        if int(valid.max()) > count:
            count, facet = int(valid.max()), int(templates.facet[valid.argmax()])
    return facet


def photograph(views: Views, view: int) -> Image.Image:
    """Give a photograph as it is looked at."""
    return picture(views.images[view].movedim(0, -1).clamp(0, 1) ** (1 / 2.2))


def silhouette(step: pt.Step, view: int) -> Image.Image:
    """Give a photograph with what is not the object left white."""
    shown = step.scene.views.images[view].movedim(0, -1).clamp(0, 1) ** (1 / 2.2)
    inside = step.silhouettes.inside[view] > 0.5
    return picture(torch.where(inside[..., None], shown, torch.ones_like(shown)))


def normals(mesh: Mesh, camera: Cameras) -> Image.Image:
    """Colour the normals of a mesh's own shape."""
    carried = mesh.replace(normals_world=vertex_normals(mesh.vertices_world, mesh.faces))
    maps = view_maps(carried, camera, 0)
    colours = normal_colors(maps.normals_cam)
    return picture(torch.where(maps.seen[..., None], colours, torch.ones_like(colours)))


def picture(values: torch.Tensor) -> Image.Image:
    """Turn values from 0 to 1 into an image."""
    return Image.fromarray((values * 255).round().to(torch.uint8).numpy())


def sheet(images: list[Image.Image], width: int, columns: int = COLUMNS) -> Image.Image:
    """Put images side by side, in rows."""
    small = [image.resize((width, round(width * image.height / image.width))) for image in images]
    height = max(image.height for image in small)
    rows = -(-len(small) // columns)
    across = min(columns, len(small))
    whole = Image.new(
        "RGB",
        (across * (width + GAP_PX) - GAP_PX, rows * (height + GAP_PX) - GAP_PX),
        "white",
    )
    for index, image in enumerate(small):
        row, column = divmod(index, columns)
        whole.paste(image, (column * (width + GAP_PX), row * (height + GAP_PX)))
    return whole


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    wanted = sys.argv[1:] or ["captures", "stages"]
    if "captures" in wanted:
        draw_captures()
    if "stages" in wanted:
        draw_stages()
