"""``pimper render``: photographs of a scene, with ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.runtime.reporting import stage

_DEFAULT = SceneConfig()
# Only in --help-all.
_RARE_NAMES = """
processes lights-per-pose elevation-deg sway-deg fill no-fixed-point-light no-fixed-room
no-fixed-table no-constant-light no-turned-over pan-jitter-px crop-jitter-px point-light-distance
irradiance window lamp-colour read-noise shot-noise supersample up rotation-deg
"""
_RARE = tuple(f"--{name}" for name in _RARE_NAMES.split())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Render photographs of a scene under a point light, and write the ground truth.

    Attributes:
        scene: One of mug, jar, balls, potatoes, pair, or the path of a mesh file.
        out: Folder for photos, masks and truth; new or empty.
        processes: Number of concurrent renderings.
        overwrite: Replace an existing rendering in OUT.
        config: Settings of the photographs.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    processes: int = 2
    overwrite: Flag = False
    config: Annotated[SceneConfig, tyro.conf.arg(name="")] = _DEFAULT


def run(job: _Job, output: Output) -> None:
    """Run ``render``."""
    with output.observer(), stage("render") as figures:
        render_scene(
            job.scene, job.out, job.config, processes=job.processes, overwrite=job.overwrite
        )
        figures["photographs"] = job.config.num_views
    option = "" if job.config.encoding == "srgb" else " --photographs.response linear"
    output.remark(
        f"{job.out}/photos contains the photographs, {job.out}/truth the ground truth. Next:\n"
        f"  pimper reconstruct {job.out}/photos -o RESULT{option}"
    )
    output.result({name: job.out / name for name in ("photos", "masks", "truth")})


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments of ``render``."""
    return read_arguments(_Job, command, arguments, rare=_RARE)
