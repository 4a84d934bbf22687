"""Nine ways to photograph one object: three paths of the camera, three materials."""

from functools import partial
from pathlib import Path

import torch
from declared import Column, Figures, Place, Row, Study, Table, bracketed, figure, listed, said
from fleet import LEAST_MET, MOST_DEG, compared, measured, reconstructed
from fleet_captures import MATERIALS, MESHES, PATHS, model

from pimper_torch.io.photographs import read_mask
from pimper_torch.runtime.errors import ReconstructionError

SHAPE = "potatoes"
SIZE = {"num_views": 20, "width": 320, "height": 240}
ALONG = {"arc": "arc of 50°", "wide": "arc of 120°", "round": "all round"}
MADE_OF = {"plain": "textured", "weak": "of one colour", "gloss": "glossy"}


def measure(place: Place, path: str, material: str) -> Figures:
    """Run the command line on a capture, and compare the result with the truth."""
    scene, upright = model(SHAPE, MESHES, place.cache / "shapes")
    capture = place.scene(scene, **SIZE, **PATHS[path], **MATERIALS[material], **upright)
    result = place.cache / "results" / f"{SHAPE}-{path}-{material}"
    try:
        row = reconstructed(capture, result, "default")
    except ReconstructionError as error:
        return {"verdict": f"refused: {str(error).partition('.')[0]}"}
    row |= measured(capture, result) | outlines(capture, result)
    good = row["normals °"] <= MOST_DEG and row["met %"] >= LEAST_MET
    words = "not usable", "look at it", "good"
    kept = {name: value for name, value in row.items() if isinstance(value, int | float)}
    return kept | {
        "Chamfer %": (row["accuracy %"] + row["completeness %"]) / 2,
        "verdict": words[(row["score"] > 0) + (row["score"] >= 0.5)],
        "is good": "yes" if good else "no",
    }


def outlines(capture: Path, result: Path) -> Figures:
    """Compare the silhouettes of a result with the true masks; it may have found none."""
    names = [path.name for path in sorted((result / "masks").glob("*.png"))]
    if not names:
        return {}
    found, known = (
        torch.stack([read_mask(folder / "masks" / name) for name in names])
        for folder in (result, capture)
    )
    return compared(found, known)


COST = (figure("CPU s", "CPU s", 0), figure("GB", "GB", 1))
VISITOR: tuple[Column, ...] = (
    figure("registered", "registered", 0),
    said("verdict", "verdict"),
    figure("normals, °", "normals °", 1),
    figure("Chamfer, %", "Chamfer %", 3),
    *COST,
)
DEVELOPER: tuple[Column, ...] = (
    figure("registered", "registered", 0),
    bracketed("IoU (worst)", "IoU", "worst", 3),
    figure("met, %", "met %", 1),
    figure("normals, °", "normals °", 1),
    figure("accuracy, %", "accuracy %", 3),
    figure("completeness, %", "completeness %", 3),
    figure("PSNR, dB", "PSNR", 1),
    figure("score", "score"),
    said("good", "is good"),
)
STUDY = Study(
    name="capture_modes",
    rows={
        (ALONG[path], MADE_OF[material]): Row(
            measure=partial(measure, path=path, material=material)
        )
        for path in ALONG
        for material in MADE_OF
    },
    tables=[
        Table(
            name="modes",
            document="docs/measuring.md",
            labels=2,
            lines=listed(["camera", "object"], VISITOR),
        ),
        Table(
            name="fleet",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(["camera", "object"], DEVELOPER),
        ),
    ],
)
