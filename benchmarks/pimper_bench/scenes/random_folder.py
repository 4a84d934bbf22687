"""A random capture as files, like those of other rendered scenes."""

from dataclasses import fields, replace
from pathlib import Path

from pimper_bench.scenes.random_captures import RandomCapture, render_random
from pimper_bench.scenes.ray_tracing import MAP_NAMES, RenderedFrame
from pimper_bench.scenes.scene_files import make_folders, write_frame, write_report
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.export.reports import write_json
from pimper_torch.geometry.lens_models import pinhole_lenses
from pimper_torch.io.meshes import write_ply
from pimper_torch.runtime.errors import ConfigError, some
from pimper_torch.stages.sfm.colmap import write_binary
from pimper_torch.stages.sfm.sparse_scene import model_of_scene, point_colors

RANDOM = "random"
"""Name of the scenes that :func:`.render_random` draws."""


def write_random(config: SceneConfig, folder: Path) -> None:
    """Render a random scene of the configured size and seed, and write its files.

    They are those of :mod:`.rendered_folder`. The cloud is one as of structure from motion, and
    ``lights.json`` has first-order harmonics only.

    Raises:
        ConfigError: Other settings than number and size of photographs and seed are given, which
            random scenes draw; or there are fewer than 3 photographs.
    """
    require_random(config)
    capture = render_random(
        config.seed, num_views=config.num_views, width=config.width, height=config.height
    )
    names, truth = capture.views.names, folder / "truth"
    make_folders(folder, names)
    for view, name in enumerate(names):
        maps = {each: getattr(capture, each)[view] for each in MAP_NAMES}
        write_frame(RenderedFrame(image=capture.views.images[view], **maps), config, folder, name)
    write_ply(capture.mesh, truth / "mesh.ply")
    write_ply(capture.surroundings, truth / "surroundings.ply")
    _write_sparse(capture, truth / "sparse")
    lights = {"names": list(names), "harmonics_world": capture.lights_world.tolist()}
    write_json(lights, truth / "lights.json", indent=1)
    write_report(RANDOM, names, config, truth)


def _write_sparse(capture: RandomCapture, folder: Path) -> None:
    model = model_of_scene(capture.scene).replace(
        lenses=pinhole_lenses(capture.cameras), cam_from_world=capture.cameras.cam_from_world
    )
    write_binary(model, point_colors(capture.scene), folder)


def require_random(config: SceneConfig) -> None:
    """Refuse settings that random scenes draw; see :func:`write_random`."""
    free = {name: getattr(config, name) for name in ("num_views", "width", "height", "seed")}
    usual = replace(SceneConfig(), **free)
    drawn = [f.name for f in fields(config) if getattr(config, f.name) != getattr(usual, f.name)]
    if drawn or config.num_views < 3:
        raise ConfigError(
            f"scene random: got {some(drawn) or f'num_views {config.num_views}'}; needed: at least "
            "3 views, width, height and seed only, as everything else is drawn by the seed."
        )
