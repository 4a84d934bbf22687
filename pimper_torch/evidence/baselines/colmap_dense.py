"""COLMAP's dense stereo (Schönberger et al., ECCV 2016), if the user has the program.

Its patch match needs an NVIDIA GPU. The Python package of COLMAP that SfM uses here is built
without; what is run is the program ``colmap``.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import torch

from pimper_torch.config import Range, require, require_at_most, require_ranges
from pimper_torch.cores import usable_cores
from pimper_torch.errors import MissingProgramError, ReconstructionError
from pimper_torch.evidence.baselines.exchange import (
    estimate_of,
    read_surface,
    write_masks,
    write_photographs,
    write_pinhole_model,
)
from pimper_torch.evidence.baselines.external import (
    Deadline,
    Program,
    run_program,
    workspace,
)
from pimper_torch.exchange.colmap_workspace import write_stereo_folder
from pimper_torch.progress import report
from pimper_torch.records import CoarseMesh, Estimate, SparseScene
from pimper_torch.stage import Stage

COLMAP = Program(
    name="colmap",
    variable="PIMPER_COLMAP",
    source="https://colmap.github.io, built with CUDA",
)

_FUSED, _MESHED = "fused.ply", "meshed.ply"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapDenseConfig:
    """COLMAP's settings under its defaults, but for the trim of Poisson's surface.

    Attributes:
        program: The executable or its folder; else PIMPER_COLMAP or the PATH say.
        max_size_px: Longer side of the photographs that are compared; -1 for any.
        mesher: What makes a mesh of the fused points; ``none`` gives the points themselves.
        poisson_trim: Depth of the octree below which Poisson's surface is trimmed away; by the
            number of points if not set, see :func:`trim_depth`.
        gpu: Number of the GPU, several with commas; -1 for all.
        threads: 0 for all cores.
        max_minutes: For all steps together; then it is stopped.
        keep_in: Folder to leave its files in; else they are removed.
    """

    program: Path | None = None
    max_size_px: int = -1
    mesher: Literal["poisson", "delaunay", "none"] = "poisson"
    poisson_trim: float | None = None
    gpu: str = "-1"
    threads: Annotated[int, Range(least=0, most=1024)] = 0
    max_minutes: Annotated[float, Range(above=0)] = 120.0
    keep_in: Path | None = None

    def __post_init__(self) -> None:
        require_ranges(self)
        size = self.max_size_px
        require(size == -1 or size > 0, "max_size_px", size, "-1, or above 0")
        require_at_most(self, max_size_px=65_535)
        trim = self.poisson_trim
        within = trim is None or 0 <= trim <= 32
        require(within, "poisson_trim", trim, "0 to 32, as deep as octrees are, or nothing")


@dataclass(frozen=True, slots=True)
class Step:
    """One of COLMAP's commands with its arguments."""

    name: str
    arguments: tuple[str, ...]


class ColmapDense(Stage):
    """Patch match with geometric consistency, fusion, and Poisson's or Delaunay's surface."""

    def __init__(self, config: ColmapDenseConfig | None = None) -> None:
        super().__init__()
        self.config = config or ColmapDenseConfig()

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Run COLMAP's dense stereo on the scene's photographs, cameras and cloud.

        Depths off the masks are left out of the fusion if there are masks.

        Args:
            scene: Its cloud chooses pairs of views and ranges of depth.

        Returns:
            A mesh in the scene's frame, or points with normals.

        Raises:
            MissingProgramError: There is no colmap here.
            ReconstructionError: It has no CUDA, failed, took too long, or found nothing.
            InputError: The scene has no cloud.
        """
        config = self.config
        program = COLMAP.find(config.program)
        threads = config.threads or usable_cores()
        with workspace("colmap", config.keep_in) as folder:
            names = write_photographs(scene, folder / "images", ".png")
            write_pinhole_model(scene, names, folder / "sparse")
            write_stereo_folder(names, folder / "stereo")
            masked = write_masks(scene, folder / "masks", ".png.png")
            run = partial(_run, program, folder, Deadline(config.max_minutes), threads)
            run(match_step(config, folder))
            report(1, 3)
            printed = run(fuse_step(config, folder, threads=threads, masked=masked))
            report(2, 3)
            mesh = read_surface(folder / _FUSED, "colmap stereo_fusion", printed)
            if config.mesher != "none":
                num_points = len(mesh.vertices_world)
                step = mesh_step(config, folder, num_points, threads=threads)
                mesh = read_surface(folder / _MESHED, f"colmap {step.name}", run(step))
            report(3, 3)
        return estimate_of(mesh, scene, coarse)


def match_step(config: ColmapDenseConfig, folder: Path) -> Step:
    """Depth and normals of every view, first alone, then consistent with one another."""
    return Step(
        "patch_match_stereo",
        (
            *("--workspace_path", str(folder), "--workspace_format", "COLMAP"),
            *("--PatchMatchStereo.max_image_size", str(config.max_size_px)),
            *("--PatchMatchStereo.geom_consistency", "true"),
            *("--PatchMatchStereo.gpu_index", config.gpu),
        ),
    )


def fuse_step(config: ColmapDenseConfig, folder: Path, *, threads: int, masked: bool) -> Step:
    """Points where the views' depths agree."""
    masks = ("--StereoFusion.mask_path", str(folder / "masks")) if masked else ()
    return Step(
        "stereo_fusion",
        (
            *("--workspace_path", str(folder), "--workspace_format", "COLMAP"),
            *("--input_type", "geometric", "--output_path", str(folder / _FUSED)),
            *("--StereoFusion.max_image_size", str(config.max_size_px)),
            *("--StereoFusion.num_threads", str(threads)),
            *masks,
        ),
    )


def mesh_step(config: ColmapDenseConfig, folder: Path, num_points: int, *, threads: int) -> Step:
    """A surface through the points."""
    output = ("--output_path", str(folder / _MESHED))
    if config.mesher == "delaunay":
        return Step(
            "delaunay_mesher",
            (
                *("--input_path", str(folder), "--input_type", "dense", *output),
                *("--DelaunayMeshing.num_threads", str(threads)),
            ),
        )
    trim = trim_depth(num_points) if config.poisson_trim is None else config.poisson_trim
    return Step(
        "poisson_mesher",
        (
            *("--input_path", str(folder / _FUSED), *output),
            *("--PoissonMeshing.trim", f"{trim:.2f}"),
            *("--PoissonMeshing.num_threads", str(threads)),
        ),
    )


def trim_depth(num_points: int) -> float:
    """Choose the depth of the octree below which Poisson's surface is trimmed.

    COLMAP's own default, 10, suits clouds of ten million points; of a small one it trims all
    away. A surface has a quarter of the points on each level up, so that the same density, as
    a fraction of the cloud's own, lies at 10 less the quaternary logarithm of what is missing.

    >>> trim_depth(10_000_000)
    10.0
    """
    return max(0.0, 10.0 - math.log(1e7 / max(1, num_points), 4))


def _run(program: Path, folder: Path, deadline: Deadline, threads: int, step: Step) -> str:
    """Run one step; give what it printed."""
    try:
        return run_program([program, step.name, *step.arguments], folder, deadline, threads=threads)
    except MissingProgramError:
        raise
    except ReconstructionError as error:
        raise _explained(step.name, error) from error


def _explained(step: str, error: ReconstructionError) -> ReconstructionError:
    """Return the usual cause of a failing step."""
    lines = f"colmap {step}: {error}"
    if "requires CUDA" in str(error) or "CUDA error" in str(error):
        lines = (
            "COLMAP's dense stereo needs a build with CUDA and an NVIDIA GPU, and this one cannot "
            f"use any. Install one from {COLMAP.source}, or leave this method out.\n{lines}"
        )
    elif "requires CGAL" in str(error):
        lines = f"This COLMAP has no Delaunay mesher; use `mesher: poisson`.\n{lines}"
    return ReconstructionError(lines)
