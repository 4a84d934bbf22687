"""Photographs for `guards.py`: plain sets, and sets on which each guard is needed."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageDraw
from skimage.measure import marching_cubes

import pimper_torch
from pimper_bench.scenes import SceneConfig, render_scene

SKULL = Path(pimper_torch.__file__).parent / "data" / "skull"

# Next to the repository, not part of it: meshes whose y axis is up.
MESHES = Path(__file__).parents[3] / "shared" / "data" / "meshes"
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True)
class Set:
    """A scene with its number of photographs, their width, and settings of the rendering.

    ``guards`` are those that it is there for; a plain set has none. ``spoil`` changes the files and
    returns the names of the photographs that should be left out.
    """

    scene: str
    views: int
    width: int
    settings: dict[str, Any] = field(default_factory=dict)
    guards: tuple[str, ...] = ()
    spoil: Callable[[Path], list[str]] | None = None


def stamped(folder: Path) -> list[str]:
    """Write a date into the corner of every photograph."""
    for path in sorted((folder / "photos").iterdir()):
        picture = Image.open(path)
        place = picture.width - 8, picture.height - 4
        size = picture.height / 16
        ImageDraw.Draw(picture).text(
            place, "2026-03-14 15:09", "orange", anchor="rs", font_size=size
        )
        picture.save(path)
    return []


def foreign(folder: Path) -> list[str]:
    """Put a photograph of the skull in the place of one."""
    path = sorted((folder / "photos").iterdir())[2]
    size = Image.open(path).size
    Image.open(sorted(SKULL.glob("*.jpg"))[0]).convert("RGB").resize(size).save(path)
    return [path.name]


ROUND, TURN = {"path": "handheld"}, {"path": "turntable"}
PATTERN, PLAIN, GREY = {"table": "patterned"}, {"table": "plain"}, {"albedo": (0.6, 0.6, 0.6)}
ROOM = {**TURN, "fixed_point_light": True, "fixed_room": True}
TURNED = {**ROUND, **PATTERN, "elevation_deg": 22.0, "turned_over": True}
LAMP = {**PATTERN, **GREY, "ambient": 0.03}
SETS = {
    "mug-arc": Set("mug", 12, 480),
    "jar-arc": Set("jar", 24, 800, PATTERN),
    "balls-arc": Set("balls", 8, 400),
    "potatoes-arc": Set("potatoes", 8, 240, PATTERN),
    "limbs-arc": Set("limbs", 16, 640),
    "mug-round": Set("mug", 24, 640, ROUND | PATTERN),
    "jar-round": Set("jar", 30, 640, ROUND),
    "balls-round": Set("balls", 24, 480, ROUND | PATTERN),
    "potatoes-round": Set("potatoes", 30, 400, ROUND),
    "limbs-round": Set("limbs", 24, 640, ROUND | PATTERN),
    "mug-turn": Set("mug", 24, 480, TURN),
    "jar-turn": Set("jar", 20, 640, TURN | PATTERN),
    "balls-turn": Set("balls", 24, 480, TURN),
    "potatoes-turn": Set("potatoes", 24, 480, TURN | PLAIN),
    "limbs-turn": Set("limbs", 30, 480, TURN),
    "potatoes-plain": Set("potatoes", 16, 640, PLAIN),
    "mug-grey": Set("mug", 20, 640, ROUND | PATTERN | GREY),
    "limbs-grey": Set("limbs", 24, 480, ROUND | PATTERN | GREY),
    "jar-glossy": Set("jar", 16, 640, {"specular": 0.08, "roughness": 0.15}),
    "potatoes-glossy": Set("potatoes", 24, 480, ROUND | {"specular": 0.08, "roughness": 0.2}),
    "skull": Set("skull", 26, 900),
    **{
        f"{mesh}-{name}-{seed}": Set(f"{mesh}.obj", 30, 800, {**LAMP, **path, "seed": seed})
        for mesh in ("spot", "ogre", "armadillo")
        for name, path in (("arc", {}), ("round", ROUND))
        for seed in (1, 2)
    },
    "turned-over": Set("mug", 20, 480, TURNED, ("sfm.moved_object",)),
    "room": Set("mug", 24, 640, ROOM, ("sfm.static_background",)),
    "room-shifts": Set("mug", 24, 640, ROOM | {"pan_jitter_px": 40.0}, ("sfm.moved_object",)),
    "stamp": Set("mug", 16, 480, ROUND | PATTERN, ("sfm.static_background",), stamped),
    "foreign": Set("jar", 16, 480, PATTERN, ("sfm.weak_views", "sfm.misplaced"), foreign),
    "mouth": Set("mug", 20, 640, ROUND | PATTERN, ("coarse.seen_through",)),
    "flaps": Set("skull", 8, 900, {}, ("extract.borders", "coarse.fringes", "extract.pieces")),
    "shadows": Set(
        "limbs", 24, 480, ROUND | PATTERN, ("silhouettes.shadows", "photometry.shadows")
    ),
    "highlights": Set(
        "balls", 16, 480, {"specular": 0.1, "roughness": 0.1}, ("photometry.robust",)
    ),
    "few": Set("jar", 6, 400, PATTERN, ("extract.expected_error", "extract.spikes", "repair")),
}


def limbs(path: Path) -> None:
    """Write a body on four thin legs, with a handle, as one closed surface."""
    axis = np.linspace(-1.3, 1.3, 160)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    ring = np.hypot(np.hypot(x, z - 0.55) - 0.42, y) - 0.06
    field = np.minimum(ring, np.hypot(np.hypot(x / 1.6, y), z) - 0.5)
    for side in (-0.5, 0.5):
        for front in (-0.25, 0.25):
            leg = np.hypot(x - side - 0.15 * side * -z, y - front) - 0.06
            field = np.minimum(field, np.maximum(leg, np.abs(z + 0.6) - 0.6))
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(axis[1] - axis[0],) * 3)
    trimesh.Trimesh(vertices, faces).export(path)


def upright(path: Path) -> None:
    """Write a mesh of that name with its z axis up."""
    source = MESHES / path.name
    if source.exists():
        mesh = trimesh.load(source, process=False)
        vertices, faces = mesh.vertices, mesh.faces
    else:
        with np.load(source.with_suffix(".npz")) as arrays:
            vertices, faces = arrays["v"], arrays["f"]
    trimesh.Trimesh(vertices @ UPRIGHT.T, faces, process=False).export(path)


def prepared(folder: Path, name: str, tiny: bool) -> tuple[Path, list[str]]:
    """Render a set, spoil it, and list the photographs that should be left out."""
    one, place = SETS[name], folder / "scenes" / (f"{name}-tiny" if tiny else name)
    listing = place / "spoilt.json"
    if not listing.exists():
        shutil.rmtree(place, ignore_errors=True)
        views, width = (min(one.views, 8), 240) if tiny else (one.views, one.width)
        if one.scene == "skull":
            (place / "photos").mkdir(parents=True)
            for path in sorted(SKULL.glob("*.jpg"))[:views]:
                shutil.copy(path, place / "photos")
        else:
            scene = one.scene
            if scene == "limbs":
                scene = str(folder / "limbs.ply")
                limbs(folder / "limbs.ply")
            elif scene.endswith(".obj"):
                scene = str(folder / scene)
                upright(Path(scene))
            height = width * 3 // 4
            settings = {"num_views": views, "width": width, "height": height, **one.settings}
            render_scene(scene, place, SceneConfig(**settings))
        listing.write_text(json.dumps(one.spoil(place) if one.spoil else []))
    return place, json.loads(listing.read_text())
