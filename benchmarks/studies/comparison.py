"""Surfaces of this package, of OpenMVS and of the smoothed sparse cloud, from the same cameras."""

from functools import partial
from pathlib import Path

import numpy as np
from bench_runs import inputs_of, mesh_of, run
from declared import Figures, Kept, Place, Row, Study, Table, bracketed, figure, listed, number

from pimper_bench.table.bench_inputs import BenchConfig
from pimper_bench.table.contact_sheet import crop_to
from pimper_torch.io.meshes import read_mesh
from pimper_torch.viz.render import shade
from pimper_torch.viz.tiles import Tile, array, encoded, sheet

SCENES = ("jar", "potatoes", "mug", "balls")
METHODS = {
    "default": "`default`",
    "openmvs": "OpenMVS 2.3, refined",
    "smoothed": "the smoothed sparse cloud",
}
SIZE = {"num_views": 16, "width": 640, "height": 480}
PICTURED = {"openmvs": "OpenMVS", "default": "pimper_torch"}


def best(kept: Kept, scene: str, name: str) -> float:
    """Return the least figure of a scene."""
    return min(row.get(name, np.inf) for (one, _), row in kept.items() if one == scene)


def side_by_side(kept: Kept) -> list[list[str]]:
    """Return normals and Chamfer of each method on the scenes that all have; the best in bold."""
    scenes = [scene for scene in SCENES if all((scene, method) in kept for method in METHODS)]

    def cell(scene: str, method: str) -> str:
        row = kept.get((scene, method), {})
        texts = []
        for name, decimals in (("normals", 1), ("Chamfer", 2)):
            text = number(row.get(name), decimals)
            bold = name in row and text == number(best(kept, scene, name), decimals)
            texts.append(f"**{text}**" if bold else text)
        return " · ".join(texts)

    def seconds(method: str) -> str:
        return number(sum(kept[scene, method]["CPU s"] / len(scenes) for scene in scenes), 0)

    head = ["normals in degrees · Chamfer in %", *scenes, "CPU s, mean"]
    rows = [
        [told, *(cell(scene, method) for scene in scenes), seconds(method)]
        for method, told in METHODS.items()
    ]
    return [head, *rows]


def of_default(kept: Kept) -> Kept:
    """Return the rows that have expected errors, by scene."""
    return {(scene,): row for (scene, _), row in kept.items() if "ratio" in row}


EXPECTED = listed(
    ["scene"],
    [
        figure("ratio", "ratio"),
        figure("within one, %", "within one", 0),
        figure("within two, %", "within two", 0),
        figure("rank correlation", "rank"),
        figure("first decile: expected", "first expected", 3),
        figure("true", "first true", 3),
        figure("fifth: expected", "fifth expected", 3),
        figure("true", "fifth true", 3),
        figure("last: expected", "last expected"),
        figure("true", "last true"),
        figure("cameras, %", "places", 3),
    ],
)


def draw(place: Place, path: Path) -> None:
    """Draw photograph and surfaces of two scenes: the same view, material, light and crop."""
    tiles: list[list[Tile]] = []
    for scene in SCENES:
        files = {told: mesh_of(place, scene, name, **SIZE) for name, told in PICTURED.items()}
        if len(tiles) == 2 or not all(file.exists() for file in files.values()):
            continue
        inputs = inputs_of(place, scene, BenchConfig(), **SIZE)
        maps = inputs.maps
        assert maps.cameras is not None
        assert maps.truth.foreground is not None
        crop = crop_to(maps.truth.foreground[0])
        photograph = inputs.scene.views.images[inputs.coarse.reference].movedim(0, -1)
        pictures = {"photograph": encoded(photograph)}
        for told, file in files.items():
            pictures[told] = array(shade(read_mesh(file), maps.cameras))
        tiles.append([Tile(title=told, picture=one[crop]) for told, one in pictures.items()])
    if tiles:
        sheet(tiles, 400).save(path, quality=88, optimize=True)


def rival(scene: str, place: Place) -> Figures:
    """Run OpenMVS on a scene."""
    return run(place, scene, "openmvs", **SIZE)


def row_of(scene: str, method: str) -> Row:
    """Return the row of a method on a scene."""
    if method == "openmvs":
        return Row(measure=partial(rival, scene), inputs=lambda place: place.scene(scene, **SIZE))
    return Row(measure=lambda place: run(place, scene, method, **SIZE))


STUDY = Study(
    name="comparison",
    rows={(scene, method): row_of(scene, method) for scene in SCENES for method in METHODS},
    tables=[
        Table(name="readme", document="README.md", lines=side_by_side),
        Table(
            name="comparison",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["scene", "method"],
                [
                    figure("CPU s", "CPU s", 0),
                    figure("GB", "GB", 1),
                    figure("covered, %", "covered", 1),
                    figure("3D error, %", "3D error"),
                    bracketed("normals, ° (median)", "normals", "normals, median", 1),
                    figure("Chamfer, %", "Chamfer", 3),
                    figure("accuracy, %", "accuracy", 3),
                    figure("completeness seen, %", "completeness", 3),
                ],
            ),
        ),
        Table(
            name="expected",
            document="benchmarks/README.md",
            lines=lambda kept: EXPECTED(of_default(kept)),
        ),
    ],
    draw=draw,
    picture="docs/images/comparison.jpg",
)
