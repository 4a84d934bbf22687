"""The captures of `fleet.py`: shapes on three paths in four materials."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from declared import DATA
from scipy.interpolate import CubicSpline

from pimper_bench.scenes import SceneConfig, render_scene
from pimper_bench.scenes.procedural_meshes import lathe, potato
from pimper_bench.scenes.scene_objects import RECIPES
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Mesh

Settings = dict[str, Any]

MESHES = DATA / "meshes"
# Stone and plate are low, and lie in their own shadow.
SHAPES = (
    *("spot", "armadillo", "ogre", "falconstatue", "scorpion", "demosthenes-low-res", "bunny_hr"),
    *("jar", "potatoes", "stone", "plate"),
)
PATHS: dict[str, Settings] = {
    "arc": {},
    "wide": {"span_deg": 120.0},
    "round": {"path": "turntable"},
}
MATERIALS: dict[str, Settings] = {
    "plain": {},
    "weak": {"albedo": (0.6, 0.55, 0.5), "table": "patterned"},
    "gloss": {"specular": 0.05, "roughness": 0.2, "ambient": 0.06},
    "soft": {"ambient": 0.4, "irradiance": 0.5, "point_light_distance": 6.0},
}
SUBSET = (
    *("spot-arc-plain", "armadillo-wide-gloss", "ogre-round-plain"),
    *("scorpion-wide-weak", "jar-arc-soft", "stone-round-soft"),
)
SIZE, TINY = (24, 640, 480), (8, 160, 120)  # photographs, width, height
# Outer and inner profile of the plate: radius and height; its rim is far above the table.
PLATE = (
    ((0.62, 0.0), (0.66, 0.03), (0.86, 0.1), (1.08, 0.27), (1.2, 0.35)),
    ((1.18, 0.38), (1.04, 0.31), (0.82, 0.15), (0.6, 0.09), (0.3, 0.075), (0.0, 0.07)),
)


def fleet(everything: bool = False) -> dict[str, tuple[str, Settings]]:
    """Return the shape and the settings of every capture, by name."""
    return {
        f"{shape}-{path}-{material}": (shape, {**PATHS[path], **MATERIALS[material]})
        for row, shape in enumerate(SHAPES)
        for column, path in enumerate(PATHS)
        for index, material in enumerate(MATERIALS)
        if everything or (row + column) % len(MATERIALS) == index
    }


def plate() -> Mesh:
    """Return a plate on a low foot."""
    walls = []
    for corners in map(np.array, PLATE):
        along = np.concatenate([[0.0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
        walls.append(CubicSpline(along, corners)(np.linspace(0, along[-1], 60)))
    walls[-1][-1, 0] = 0.0
    return lathe(torch.from_numpy(np.concatenate([[[0.0, 0.0]], *walls])))


def stone() -> Mesh:
    """Return a flat stone."""
    grown = potato(torch.Generator().manual_seed(7))
    return grown.replace(vertices_world=grown.vertices_world * torch.tensor([1.0, 1.0, 0.4]))


def model(shape: str, meshes: Path, folder: Path) -> tuple[str, Settings]:
    """Return a shape for :func:`render_scene`, and the settings that place it upright."""
    path, source = folder / f"{shape}.ply", meshes / f"{shape}.obj"
    folder.mkdir(parents=True, exist_ok=True)
    if shape in RECIPES:
        return shape, {}
    if shape in ("stone", "plate"):
        write_ply(stone() if shape == "stone" else plate(), path)
        return str(path), {}
    if not source.exists():
        with np.load(source.with_suffix(".npz")) as arrays:
            trimesh.Trimesh(arrays["v"], arrays["f"], process=False).export(path)
        source = path
    return str(source), {"up": "y", "rotation_deg": -90.0}  # its front towards the arc


def rendered(name: str, tiny: bool, meshes: Path, out: Path) -> Path:
    """Render a capture unless its folder exists."""
    place = out / "captures" / name
    if not place.exists():
        shape, settings = fleet(everything=True)[name]
        scene, upright = model(shape, meshes, out / "meshes")
        views, width, height = TINY if tiny else SIZE
        size = {"num_views": views, "width": width, "height": height}
        seed = zlib.crc32(name.encode())
        render_scene(scene, place, SceneConfig(seed=seed, **size, **settings, **upright))
    return place
