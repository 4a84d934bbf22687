"""PMVS2 (Furukawa and Ponce, PAMI 32(8), 2010), if the user has it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.config import Range, require, require_ranges
from pimper_torch.cores import usable_cores
from pimper_torch.evidence.baselines.exchange import (
    estimate_of,
    read_surface,
    write_masks,
    write_photographs,
)
from pimper_torch.evidence.baselines.external import (
    Deadline,
    Program,
    run_program,
    workspace,
)
from pimper_torch.records import Cameras, CoarseMesh, Estimate, SparseScene
from pimper_torch.stage import Stage

PMVS2 = Program(
    name="pmvs2",
    variable="PIMPER_PMVS2",
    source="https://github.com/pmoulon/CMVS-PMVS",
)

_OPTION = "option"


@dataclass(frozen=True, slots=True, kw_only=True)
class PmvsConfig:
    """PMVS2's own settings under its own defaults.

    Attributes:
        program: The executable or its folder; else PIMPER_PMVS2 or the PATH say.
        level: Of the image pyramid that it works on; 1 halves the photographs.
        csize: One point for every cell of so many pixels squared.
        threshold: Least normalized correlation of a point's views.
        wsize: Side of the window that is compared, samples.
        min_images: Views that a point must be seen in.
        max_angle_deg: Minimum largest angle between two views of a point.
        quad: Strictness of its filter by quadrics; less is stricter.
        threads: 0 for all cores.
        max_minutes: Then it is stopped.
        keep_in: Folder to leave its files in; else they are removed.
    """

    program: Path | None = None
    level: Annotated[int, Range(least=0, most=16)] = 1  # halvings: a pixel is left
    csize: Annotated[int, Range(least=1, most=65_535)] = 2
    threshold: float = 0.7
    wsize: Annotated[int, Range(least=3, most=65_535)] = 7
    min_images: Annotated[int, Range(least=2, most=100_000)] = 3
    max_angle_deg: float = 10.0
    quad: Annotated[float, Range(above=0, most=1e6)] = 2.5
    threads: Annotated[int, Range(least=0, most=1024)] = 0
    max_minutes: Annotated[float, Range(above=0)] = 120.0
    keep_in: Path | None = None

    def __post_init__(self) -> None:
        require_ranges(self)
        require(-1 <= self.threshold <= 1, "threshold", self.threshold, "in [-1, 1]")
        require(
            0 < self.max_angle_deg < 180, "max_angle_deg", self.max_angle_deg, "above 0, below 180"
        )


class Pmvs(Stage):
    """Patch-based multi-view stereo: oriented points where neighbouring views agree."""

    def __init__(self, config: PmvsConfig | None = None) -> None:
        super().__init__()
        self.config = config or PmvsConfig()

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Run PMVS2 on the scene's photographs and cameras.

        Masks are handed over if there are some.

        Args:
            scene: Its cloud is not used.

        Returns:
            Points with outward normals, without faces, in the scene's frame.
        """
        config = self.config
        program = PMVS2.find(config.program)
        threads = config.threads or usable_cores()
        with workspace("pmvs", config.keep_in) as folder:
            # PPM: read by every build of PMVS2, and without loss, unlike JPEG.
            write_photographs(scene, folder / "visualize", ".ppm")
            write_masks(scene, folder / "masks", ".pgm")
            write_cameras(scene.cameras, folder / "txt", config.level)
            (folder / "models").mkdir()
            (folder / _OPTION).write_text(
                options(config, scene.cameras.num_views, threads), encoding="ascii"
            )
            # It builds file names as prefix + name, in buffers of 1024 bytes: a short prefix
            # that ends in a slash.
            printed = run_program(
                [program, "./", _OPTION], folder, Deadline(config.max_minutes), threads=threads
            )
            mesh = read_surface(folder / "models" / f"{_OPTION}.ply", PMVS2.name, printed)
        return estimate_of(mesh, scene, coarse)


def options(config: PmvsConfig, num_views: int, threads: int) -> str:
    """Write the file of options: every view is a target, and may be matched with any other."""
    settings = {
        "timages": f"-1 0 {num_views}",  # from the first up to, without, the last
        "oimages": 0,
        "level": config.level,
        "csize": config.csize,
        "threshold": config.threshold,
        "wsize": config.wsize,
        "minImageNum": config.min_images,
        "CPU": threads,
        "useVisData": 0,
        "sequence": -1,
        "maxAngle": config.max_angle_deg,
        "quad": config.quad,
    }
    return "".join(f"{name} {value}\n" for name, value in settings.items())


def write_cameras(cameras: Cameras, folder: Path, level: int) -> None:
    """Write one file a view: the word CONTOUR and the 3 x 4 projection matrix."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, matrix in enumerate(projections(cameras, level).tolist()):
        rows = "".join(" ".join(repr(value) for value in row) + "\n" for row in matrix)
        (folder / f"{index:08d}.txt").write_text("CONTOUR\n" + rows, encoding="ascii")


def projections(cameras: Cameras, level: int) -> Float[Tensor, "view 3 4"]:
    r"""Return the matrices that map homogeneous world points to PMVS2's pixels, in float64.

    PMVS2 counts pixels from the centre of the top-left one. Climbing its pyramid it halves
    coordinates, as if centres stayed centres, while it averages pixels :math:`2x-1` to
    :math:`2x+2`, whose centre is :math:`2x + 1/2`. Pixel :math:`u`, counted from the corner,
    lies at :math:`u / 2^l - 1/2` on level ``l``; so :math:`u - 2^l / 2` is written, to be right
    on the level that it works on.
    """
    shifted = cameras.intrinsics.detach().cpu().double().clone()
    shifted[:, :2] = shifted[:, :2] - 0.5 * 2**level * shifted[:, 2:3]
    return shifted @ cameras.cam_from_world.detach().cpu().double()[:, :3]
