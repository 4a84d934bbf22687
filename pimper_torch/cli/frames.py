"""``pimper frames``: extract photographs from a video."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.folders import prepare_output, require_apart, written_whole
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.progress import report


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Extract photographs from a video: sharp frames, evenly spaced along the camera's path.

    Attributes:
        video: MP4, MOV, MKV, WebM or AVI; needs pip install "pimper_torch[video]".
        out: Folder for the photographs (PNG); new or empty.
        count: Number of photographs.
        overwrite: Replace photographs of an earlier `pimper frames` in OUT.
    """

    video: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIDEO")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    count: int = 40
    overwrite: Flag = False

    def __post_init__(self) -> None:
        require(3 <= self.count <= 10_000, "count", self.count, "3 to 10,000")


def run(job: _Job, output: Output) -> None:
    """Run ``frames``."""
    from PIL import Image

    from pimper_torch.cli.video.choose import chosen, scanned
    from pimper_torch.cli.video.read import frame_pictures, luma_frames
    from pimper_torch.runtime.reporting import stage

    with output.observer():
        with stage("scan") as figures:
            scan = scanned(luma_frames(job.video))
            figures["frames"] = len(scan.way)
        frames = chosen(scan, job.count)
        written = written_whole(job.out, "frames", overwrite=job.overwrite)
        with stage("write") as figures, written as folder:
            pictures = frame_pictures(job.video, frames.tolist())
            for done, (number, picture) in enumerate(pictures, start=1):
                Image.fromarray(picture).save(folder / f"{number:06d}.png")
                report(done, len(frames))
            figures["photographs"] = len(frames)
    if len(frames) < job.count:
        caution(
            f"{job.video}: has {len(frames)} different frames instead of {job.count}; the others "
            "are nearly copies of these. Move the camera farther, or more slowly if the picture "
            "jumps.",
            stacklevel=2,
        )
    output.remark(
        f"{len(frames)} of {len(scan.way)} frames are in {job.out}. Next:\n"
        f"  pimper reconstruct {job.out} -o RESULT"
    )
    output.result({"folder": job.out}, photographs=len(frames), frames=len(scan.way))


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Return the arguments, and refuse an occupied folder."""
    job = read_arguments(_Job, command, arguments)
    require_apart(job.out, {"VIDEO": job.video})
    prepare_output(job.out, "frames", job.overwrite)
    return job
