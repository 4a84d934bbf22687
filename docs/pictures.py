"""Draw the pictures of the documentation.

``python docs/pictures.py [captures] [stages] [walk] [reports]``

Captures are sheets of photographs that ``pimper render`` makes with the commands in
``docs/photographs.md``. Stages are drawn from the bundled skull, and so is the path of the
photographs through the subpackages. Reports are the pages of the commands in ``docs/gallery.md``,
with some of the photographs; their mesh files are looked for in the current folder.
"""

import json
import re
import subprocess
import sys
import tempfile
import threading
from collections import defaultdict
from pathlib import Path
from types import CodeType, FrameType

import matplotlib.pyplot as plt
import torch
from PIL import Image

import pimper_torch as pt
from pimper_torch.cli.options import bundled_photographs
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.render import crop_to, image_bounds, shade

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
REPORTS = DOCS / "static" / "reports"
PACKAGE = Path(pt.__file__).parent
CAPTURE = re.compile(r"^    pimper render (.+) -o ([\w-]+)$", flags=re.MULTILINE)

RUN = re.compile(r"^    (pimper .*\bcaptures/.*)$", flags=re.MULTILINE)

# Of a report: where the page has its data, and the number of photographs that stay.
DATA = re.compile(r'(<script type="application/json" id="data">)(.*?)(</script>)', flags=re.DOTALL)
KEPT = 4

# Of a sheet: photographs per row, and the width of each.
COLUMNS, WIDTH_PX, GAP_PX = 4, 236, 4

# Of the pictures of stages: the longer side of a panel, the reference photograph, and the
# margin around the object.
PANEL_PX, REFERENCE, MARGIN = 320, "37", 0.02

# Of the walk: the label of each stage's functions, and the size of the photographs.
STAGES = {
    "load_views": "load_views",
    "Reconstruct.": "reconstruct",
    "FindSilhouettes.": "silhouettes",
    "TraceContours.": "contours",
    "CoarseSurface.": "coarse_surface",
    "Decompose.": "decompose",
    "Warp.": "warp",
    "FitLight.": "light",
    "Factorize.": "factorize",
    "Sweep.": "sweep",
    "FixGauge.": "gauge",
    "Fuse.": "fuse",
    "Repair.": "repair",
    "Remesh.": "remesh",
    "Extract.": "extract",
}
WALK_PX = 600

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
    """Reconstruct the bundled skull, and draw the results of the stages of every pass."""
    views = pt.load_views(bundled_photographs())
    chain = pt.load_chain("default", {"coarse_surface": {"reference": REFERENCE}})
    passes: list[Image.Image] = []
    for step in chain.steps(views):
        view = step.coarse.reference
        camera = step.scene.cameras.take([view])
        surface = Mesh(vertices_world=step.surface.vertices_world, faces=step.surface.faces)
        around = crop_to(camera, step.coarse.mesh.vertices_world, PANEL_PX, MARGIN)
        if not passes:
            low, high = image_bounds(camera, step.coarse.mesh.vertices_world, MARGIN)
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


def draw_walk() -> None:
    """Reconstruct the bundled skull, and count each stage's functions by subpackage."""
    walk = Walk()
    walk.begin()
    chain = pt.load_chain("default")
    chain(pt.load_views(bundled_photographs(), max_size_px=WALK_PX))
    walk.end()
    counts = {place: len(functions) for place, functions in walk.entered.items()}
    stages = list(STAGES.values())
    first = {
        subpackage: min(stages.index(s) for s, r in counts if r == subpackage)
        for _, subpackage in counts
    }
    many = {subpackage: sum(r == subpackage for _, r in counts) for subpackage in first}
    subpackages = sorted(
        first, key=lambda subpackage: (many[subpackage] > 5, first[subpackage], many[subpackage])
    )
    figure, axes = plt.subplots(figsize=(9, 0.27 * len(subpackages) + 1.2), layout="constrained")
    for (stage, subpackage), count in counts.items():
        x, y = stages.index(stage), subpackages.index(subpackage)
        axes.scatter(x, y, s=3.0 * count + 60, color="#9ecae1")
        axes.text(x, y, str(count), ha="center", va="center", fontsize=7)
    axes.set_xticks(range(len(stages)), stages, rotation=45, ha="left")
    axes.set_yticks(range(len(subpackages)), subpackages)
    axes.xaxis.tick_top()
    axes.invert_yaxis()
    axes.grid(visible=True, color="#eeeeee")
    axes.set_axisbelow(True)
    figure.savefig(IMAGES / "walk.png", dpi=90)


def write_reports() -> None:
    """Run the commands of the gallery, and keep a small page of each result."""
    commands = RUN.findall((DOCS / "gallery.md").read_text(encoding="utf-8"))
    meshes = {path.name: path for path in Path.cwd().glob("*.obj")}
    REPORTS.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for command in commands:
            words = [str(meshes.get(word, word)) for word in command.split()]
            subprocess.run(words, cwd=folder, check=True)
            page = Path(folder) / words[words.index("-o") + 1] / "report.html"
            if page.exists():
                text = with_fewer_views(page.read_text(encoding="utf-8"))
                (REPORTS / f"{page.parent.name}.html").write_text(text, encoding="utf-8")


def with_fewer_views(page: str) -> str:
    """Remove photographs from a report, except the reference and some evenly spaced ones."""
    found = DATA.search(page)
    assert found, "the page has no data"
    data = json.loads(found[2])
    count, reference = len(data["views"]), data["reference"]
    kept = sorted({(reference + step * count // KEPT) % count for step in range(KEPT)})
    data["views"] = [data["views"][view] for view in kept]
    data["reference"] = kept.index(reference)
    text = json.dumps(data, ensure_ascii=False).replace("<", "\\u003c")
    return f"{page[: found.start(2)]}{text}{page[found.end(2) :]}"


class Walk:
    """The called functions of the package, by stage and subpackage.

    A function belongs to the innermost stage that called it; in a thread of a stage, to that stage.
    """

    def __init__(self) -> None:
        self.entered: dict[tuple[str, str], set[CodeType]] = defaultdict(set)
        self._known: dict[CodeType, tuple[str | None, str | None]] = {}
        self._main = threading.get_ident()
        self._stages: dict[int, list[str | None]] = defaultdict(list)

    def begin(self) -> None:
        """Watch the calls of this thread and of those that it starts."""
        threading.setprofile(self._watch)
        sys.setprofile(self._watch)

    def end(self) -> None:
        """Watch no longer."""
        sys.setprofile(None)
        threading.setprofile(None)

    def _watch(self, frame: FrameType, event: str, _: object) -> None:
        stack = self._stages[threading.get_ident()]
        if event == "return" and stack:
            stack.pop()
        if event != "call":
            return
        code = frame.f_code
        if code not in self._known:
            self._known[code] = stage_of(code), subpackage_of(code)
        stage, subpackage = self._known[code]
        above = stack or self._stages[self._main]
        stack.append(stage or (above[-1] if above else None))
        if subpackage and stack[-1]:
            self.entered[stack[-1], subpackage].add(code)


def stage_of(code: CodeType) -> str | None:
    """Return the stage that a function is a method of."""
    found = (stage for start, stage in STAGES.items() if code.co_qualname.startswith(start))
    return next(found, None) if "pimper_torch" in code.co_filename else None


def subpackage_of(code: CodeType) -> str | None:
    """Return the folder of a function, for stages the one inside `stages`."""
    try:
        folders = Path(code.co_filename).relative_to(PACKAGE).parts[:-1]
    except ValueError:
        return None
    return folders[:2][-1] if folders else "(modules outside subpackages)"


def largest(step: pt.Step) -> int:
    """Find the facet of most samples with a photometric normal."""
    count, facet = 0, 0
    for templates, bucket in zip(step.patches.buckets, step.photometric.buckets, strict=True):
        valid = bucket.valid.flatten(1).sum(dim=1)
        if int(valid.max()) > count:
            count, facet = int(valid.max()), int(templates.facet[valid.argmax()])
    return facet


def photograph(views: Views, view: int) -> Image.Image:
    """Return a photograph for display."""
    return picture(views.images[view].movedim(0, -1).clamp(0, 1) ** (1 / 2.2))


def silhouette(step: pt.Step, view: int) -> Image.Image:
    """Return a photograph with white background."""
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
    wanted = sys.argv[1:] or ["captures", "stages", "walk", "reports"]
    if "captures" in wanted:
        draw_captures()
    if "stages" in wanted:
        draw_stages()
    if "walk" in wanted:
        draw_walk()
    if "reports" in wanted:
        write_reports()
