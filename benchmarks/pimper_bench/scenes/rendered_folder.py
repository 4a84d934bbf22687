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
                                :func:`~pimper_bench.scenes.scene_files.write_maps`
==============================  ====================================================
"""

from collections import deque
from pathlib import Path

import torch

from pimper_bench.scenes.procedural_meshes import join
from pimper_bench.scenes.random_folder import RANDOM, write_random
from pimper_bench.scenes.ray_tracing import TracedObjects, render_frame
from pimper_bench.scenes.scene_files import make_folders, write_frame, write_report
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.true_clouds import true_model
from pimper_bench.scenes.whole_scene import Scene, build_scene
from pimper_torch.export.reports import write_json
from pimper_torch.export.result_folder.folders import require_apart, written_whole
from pimper_torch.io.meshes import write_ply
from pimper_torch.radiometry import to_bytes
from pimper_torch.runtime.config import require
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.sfm.colmap import write_binary


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
        name_or_path: ``mug``, ``jar``, ``balls``, ``potatoes``, ``pair``, ``random`` as of
            :func:`.render_random`, or the path of a mesh file.
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
        if name_or_path == RANDOM:
            write_random(config, staging)
            return folder
        scene = build_scene(name_or_path, config)
        make_folders(staging, scene.names)
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
        write_frame(frame, scene.config, folder, scene.names[view])

    former = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        deque(side_by_side(render, range(scene.config.num_views)), maxlen=0)
    finally:
        torch.set_num_threads(former)


def _write_truth(scene: Scene, folder: Path) -> None:
    surface, around = scene.object_mesh, scene.surroundings_mesh
    write_ply(surface, folder / "mesh.ply")
    if around is not None:
        write_ply(around, folder / "surroundings.ply")
    generator = torch.Generator().manual_seed(scene.config.seed)
    blockers = surface if around is None else join(surface, around)
    model, albedo = true_model(surface, blockers, scene.cameras, scene.names, generator)
    write_binary(model, to_bytes(albedo), folder / "sparse")
    write_json(_lights_report(scene), folder / "lights.json", indent=1)
    write_report(scene.name, scene.names, scene.config, folder)


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
