"""A rendered scene as a folder: photographs and ground truth.

==============================  ====================================================
file                            content
==============================  ====================================================
`photos/view_000.png` ...       the photographs
`masks/view_000.png` ...        white on the object
`photos/pose_00/light_00.png`   with ``lights_per_pose``; masks and maps accordingly
`truth/scene.json`              every setting, the photographs' names, the version
`truth/sparse/`                 COLMAP model: exact cameras, true points, their tracks
`truth/lights.json`             point lights of every photograph, and first-order harmonics
`truth/mesh.ply`                the object
`truth/surroundings.ply`        its table, if that rotates with the object
`truth/maps/view_000.npz` ...   depth, normals, albedo and masks of every pixel; see
                                :func:`write_maps`
==============================  ====================================================
"""

import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import join
from pimper_bench.scenes.ray_tracing import RenderedFrame, TracedObjects, render_frame
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.true_clouds import true_model
from pimper_bench.scenes.whole_scene import Scene, build_scene
from pimper_torch.export.result_folder.folders import require_apart, written_whole
from pimper_torch.io.decode import write_deep_png
from pimper_torch.io.meshes import write_ply
from pimper_torch.io.version import installed_version
from pimper_torch.radiometry import srgb_from_linear, to_bytes
from pimper_torch.runtime.config import require, to_mapping
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.sfm.colmap import write_binary

_MASKS = ("foreground", "lit", "highlight")


def write_maps(frame: RenderedFrame, path: Path) -> None:
    """Write the maps of a frame as a compressed ``.npz``.

    Depth is float32 as rendered. Normals and albedo are float16, off by at most 0.03 degrees
    and 0.0003; masks are packed, eight pixels per byte, row by row.
    """
    height, width = frame.depth.shape
    np.savez_compressed(
        path,
        size=np.array([width, height]),
        depth=frame.depth.float().numpy(),
        normals_world=frame.normals_world.to(torch.float16).numpy(),
        albedo=frame.albedo.to(torch.float16).numpy(),
        foreground=np.packbits(frame.foreground.numpy(), axis=1),
        lit=np.packbits(frame.lit.numpy(), axis=1),
        highlight=np.packbits(frame.highlight.numpy(), axis=1),
        allow_pickle=False,
    )


def unpack_maps(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return the maps that :func:`write_maps` wrote, with unit normals, and masks as booleans."""
    width = int(arrays["size"][0])
    maps = {
        name: torch.from_numpy(
            np.unpackbits(np.asarray(arrays[name]), axis=1, count=width).astype(bool)
        )
        for name in _MASKS
    }
    maps["depth"] = torch.from_numpy(np.asarray(arrays["depth"]))
    normals = torch.from_numpy(np.asarray(arrays["normals_world"])).float()
    maps["normals_world"] = normalize(normals, dim=-1)
    maps["albedo"] = torch.from_numpy(np.asarray(arrays["albedo"])).float()
    return maps


FORMAT, FORMAT_VERSION = "pimper_torch rendered scene", 1


def render_scene(
    name_or_path: str | Path,
    folder: Path | str,
    config: SceneConfig | None = None,
    *,
    processes: int = 2,
    overwrite: bool = False,
) -> Path:
    """Render photographs and ground truth to a new or empty folder, and return it.

    The folder is written atomically; :mod:`.rendered_folder` lists its contents. The same
    settings give the same files, for any number of threads.

    Args:
        name_or_path: ``mug``, ``jar``, ``balls``, ``potatoes``, ``pair``, or the path of a mesh
            file.
        processes: Number of threads, which render one photograph each.

    Raises:
        InputError: The scene does not exist, or its mesh cannot be read.
        OutputError: The folder contains other files, or cannot be written.
    """
    require(processes >= 1, "processes", processes, "at least 1")
    folder = Path(folder)
    if Path(name_or_path).exists():
        require_apart(folder, {"the scene's mesh": Path(name_or_path)})
    with written_whole(folder, "scene", overwrite=overwrite) as staging:
        config = SceneConfig() if config is None else config
        scene = build_scene(name_or_path, config)
        for part in ("photos", "masks", "truth/maps"):
            for subfolder in {Path(name).parent for name in scene.names}:
                (staging / part / subfolder).mkdir(parents=True)
        _write_truth(scene, staging / "truth")
        _render_all(scene, staging, min(processes, config.num_views))
    return folder


def _render_all(scene: Scene, folder: Path, threads: int) -> None:
    shared = TracedObjects(scene.objects_in(0))

    def render(view: int) -> None:
        stage = TracedObjects(scene.objects_in(view)) if scene.fixed else shared
        frame = render_frame(
            stage, scene.cameras, scene.lights, view, scene.noise(view), scene.config.sensor
        )
        name = scene.names[view]
        _write_photograph(frame.image, scene.config, folder / "photos" / name)
        mask = Image.fromarray(255 * frame.foreground.numpy().astype(np.uint8))
        mask.save(folder / "masks" / name)
        write_maps(frame, (folder / "truth" / "maps" / name).with_suffix(".npz"))

    former = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        deque(side_by_side(render, range(scene.config.num_views)), maxlen=0)
    finally:
        torch.set_num_threads(former)


def _write_photograph(
    image: Float[Tensor, "channel height width"], config: SceneConfig, path: Path
) -> None:
    trailing = image.movedim(0, -1)
    encoded = srgb_from_linear(trailing) if config.encoding == "srgb" else trailing
    if config.bits == 16:
        write_deep_png((65535 * encoded).round().numpy().astype(np.uint16), path)
    else:
        samples = (255 * encoded).round().numpy().astype(np.uint8)
        # Higher compression levels hardly shrink noise further.
        Image.fromarray(samples).save(path, compress_level=1)


def _write_truth(scene: Scene, folder: Path) -> None:
    surface, around = scene.object_mesh, scene.surroundings_mesh
    write_ply(surface, folder / "mesh.ply")
    if around is not None:
        write_ply(around, folder / "surroundings.ply")
    generator = torch.Generator().manual_seed(scene.config.seed)
    blockers = surface if around is None else join(surface, around)
    model, albedo = true_model(surface, blockers, scene.cameras, scene.names, generator)
    write_binary(model, to_bytes(albedo), folder / "sparse")
    _write_json(_lights_report(scene), folder / "lights.json")
    report = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "pimper_torch": installed_version(),
        "scene": scene.name,
        "names": list(scene.names),
        "settings": to_mapping(scene.config),
    }
    _write_json(report, folder / "scene.json")


def _lights_report(scene: Scene) -> dict[str, object]:
    lights = scene.lights
    return {
        "names": list(scene.names),
        "positions_world": lights.positions_world.tolist(),
        "irradiance": lights.irradiance.tolist(),
        "ambient": lights.ambient.tolist(),
        "target_world": lights.target_world.tolist(),
        "harmonics_world": lights.harmonics_world().tolist(),
    }


def _write_json(report: Mapping[str, object], path: Path) -> None:
    text = json.dumps(report, indent=1, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
