"""``pimper render``: photographs of a scene, with ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_bench.scenes.many_scenes import render_scenes
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.cli.stopping import Stopped
from pimper_torch.runtime.config import require
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
        scene: One of mug, jar, balls, potatoes, pair; random, where the seed draws everything but
            number and size of photographs; or the path of a mesh file.
        out: Folder for photos, masks and truth; new or empty.
        seeds: A scene for each seed, such as 0:100 without 100, in OUT/SCENE_000000 and so on; with
            scenes that are there from an earlier call, which are not rendered again.
        processes: Number of concurrent renderings.
        overwrite: Replace an existing rendering in OUT.
        config: Settings of the photographs.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    seeds: Annotated[str | None, tyro.conf.arg(metavar="FIRST:END")] = None
    processes: int = 2
    overwrite: Flag = False
    config: Annotated[SceneConfig, tyro.conf.arg(name="")] = _DEFAULT


def run(job: _Job, output: Output) -> None:
    """Run ``render``."""
    seeds = _seeds(job)
    if seeds is not None:
        _render_seeds(job, seeds, output)
        return
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


def _render_seeds(job: _Job, seeds: range, output: Output) -> None:
    with output.observer(), stage("render") as figures:
        try:
            rendered = render_scenes(
                job.scene,
                job.out,
                seeds,
                job.config,
                processes=job.processes,
                overwrite=job.overwrite,
            )
        except Stopped as error:
            error.left = "finished scenes stay, and the same command renders the others."
            raise
        figures["scenes"] = sum(rendered.values())
    output.remark(
        f"{job.out} contains {len(seeds)} scenes of {job.config.num_views} photographs; "
        f"{figures['scenes']} were rendered now. In Python: pt.data.Captures({str(job.out)!r})"
    )
    output.result({"scenes": job.out}, rendered=figures["scenes"], scenes=len(seeds))


def _seeds(job: _Job) -> range | None:
    """Return the seeds of ``--seeds``; ``None`` without it."""
    if job.seeds is None:
        return None
    first, _, end = job.seeds.partition(":")
    seeds = range(int(first), int(end)) if first.isdecimal() and end.isdecimal() else range(0)
    needed = "FIRST:END, such as 0:100 for 0 to 99"
    require(len(seeds) > 0 and seeds.stop <= 2**32, "--seeds", job.seeds, needed)
    require(job.config.seed == 0, "--seed", job.config.seed, "--seeds or --seed, not both")
    return seeds


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments of ``render``."""
    job = read_arguments(_Job, command, arguments, rare=_RARE)
    _seeds(job)
    return job
