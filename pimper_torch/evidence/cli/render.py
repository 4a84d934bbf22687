"""``pimper render``: photographs of a scene, with the truth beside them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from pimper_torch.cli.bars import Bars
from pimper_torch.evidence.scenes.config import SceneConfig
from pimper_torch.evidence.scenes.write import render_scene
from pimper_torch.progress import listening
from pimper_torch.records import StageReport
from pimper_torch.reporting import peak_memory_mb

Flag = tyro.conf.FlagCreatePairsOff[bool]

_DEFAULT = SceneConfig()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    scene: str
    out: Path
    processes: int
    overwrite: bool
    config: SceneConfig


def run(command: str, arguments: Sequence[str]) -> None:
    """Carry out ``render``.

    Raises:
        PimperError: Before anything is written.
    """
    job = checked(command, arguments)
    console = Console(stderr=True)
    with Bars(console) as bars:
        began = time.perf_counter()
        bars.started("render")
        with listening(bars.progressed):
            render_scene(
                job.scene,
                job.out,
                job.config,
                processes=job.processes,
                overwrite=job.overwrite,
            )
        bars.finished(
            StageReport(
                name="render",
                seconds=time.perf_counter() - began,
                peak_memory_mb=peak_memory_mb(),
                figures={"photographs": job.config.num_views},
            )
        )
    option = "" if job.config.encoding == "srgb" else " --photographs.response linear"
    Console().print(
        f"{job.out}/photos are the photographs, {job.out}/truth is what they show. Next:\n"
        f"  pimper reconstruct {job.out}/photos -o RESULT{option}",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments of ``render``.

    Raises:
        ConfigError: An impossible setting.
        SystemExit: Unknown or wrong arguments, reported by tyro, or ``--help``.
    """

    def render(
        scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")],
        out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")],
        processes: int = 2,
        overwrite: Flag = False,
        config: Annotated[SceneConfig, tyro.conf.arg(name="")] = _DEFAULT,
    ) -> _Job:
        """Render photographs of a scene under a point light, and write the truth beside them.

        Args:
            scene: One of mug, jar, balls, potatoes, pair, or the path of a mesh file.
            out: Folder for photos, masks and truth; new or empty.
            processes: That render at the same time.
            overwrite: Replace a former rendering in OUT.
            config: The photographs.
        """
        return _Job(scene=scene, out=out, processes=processes, overwrite=overwrite, config=config)

    return tyro.cli(render, prog=f"pimper {command}", args=list(arguments))
