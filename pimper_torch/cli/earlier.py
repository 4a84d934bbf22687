"""The result of a run's chain, kept for runs with other options of files and units."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

from torch import Tensor

from pimper_torch.cli.options import InputOptions, Job, inputs_of
from pimper_torch.geometry.undistortion import undistort
from pimper_torch.io.photographs import load_views
from pimper_torch.priors.salient_networks import network_identity
from pimper_torch.records import Reconstruction, Record
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.events import Caution
from pimper_torch.runtime.reporting import HASH, aside, stage
from pimper_torch.runtime.stream import collected
from pimper_torch.store import Store, deferred, digest, kept, tensor_hash
from pimper_torch.store.digest import code


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class KeptResult(Record):
    """A chain's result without the photographs, which are read again if they are needed.

    Attributes:
        result: Its images have no channels.
        channels: Of the photographs.
        hashed: Hash of their images.
    """

    result: Reconstruction
    channels: int
    hashed: str


def reconstructed(
    job: Job, store: Store | None, run: Callable[[], Reconstruction]
) -> Reconstruction:
    """Return the result of a run's chain on the CPU, computed or kept by an earlier run.

    The photographs of a kept result are deferred, see :mod:`~pimper_torch.store.deferred`.

    Args:
        run: Reads all inputs and calls the chain.
    """
    made = list[Tensor]()

    def without_images() -> KeptResult:
        result = run().to("cpu")
        made.append(result.scene.views.images)
        bare, channels = _with_images(result, made[0][:, :0]), made[0].shape[1]
        return KeptResult(result=bare, channels=channels, hashed=tensor_hash(made[0]))

    with aside(HASH):
        request = _request(job) if store else None
    key = f"result-{request}" if request else None
    record, _ = kept(store, key, KeptResult, without_images)
    if not made:
        count, _, *size = record.result.scene.views.images.shape
        read = cache(partial(_photographs, job, record))
        made.append(deferred((count, record.channels, *size), record.hashed, read))
    return _with_images(record.result, made[0])


def _with_images(result: Reconstruction, images: Tensor) -> Reconstruction:
    scene = result.scene
    return result.replace(scene=scene.replace(views=scene.views.replace(images=images)))


def _photographs(job: Job, record: KeptResult) -> Tensor:
    """Read and undistort the photographs of a kept result, without repeating warnings."""
    encoding, size = job.config.photographs, job.common.max_size_px or 0
    with stage("photographs"), collected(Caution):
        scene = record.result.scene
        views = load_views(job.photos, encoding=encoding, max_size_px=size)
        views = views.take([views.names.index(name) for name in scene.views.names])
        images = undistort(views.to(job.common.device), scene.lenses)[0].images.cpu()
    if tensor_hash(images) != record.hashed:
        raise InputError(
            f"{job.photos}: its photographs differ from those of the kept result. Run again with "
            "`--fresh`."
        )
    return images


def _request(job: Job) -> str | None:
    """Return a hash of all files and options on which the result of the chain depends.

    Files are compared by name, size and time of their last change.
    """
    inputs, config, none = job.inputs, job.config, InputOptions()
    if getattr(config, "hold_out", 0):  # there are two sets of photographs
        return None
    paths = {**inputs_of(job), "--cache": None, "response": Path(str(config.photographs.response))}
    files = [
        (str(path), path.stat().st_size, path.stat().st_mtime_ns)
        for source in filter(None, paths.values())
        for path in sorted([source, *(found for depth in _DEPTHS for found in source.glob(depth))])
        if path.is_file() and not path.resolve().is_relative_to(job.out.resolve())
    ]
    network = network_identity(inputs.segmenter) if inputs.segmenter else ""
    others = replace(inputs, **{name: getattr(none, name) for name in _AFTERWARDS})
    options = config, others, job.common.device, job.common.max_size_px
    return digest(code(), str(job.photos), files, network, options)


# Files of a folder that a run can read: up to folders of poses, each with one per photograph.
_DEPTHS = ("*", "*/*", "*/*/*")
# Options that are used after the chain.
_AFTERWARDS = ("scale_bar", "camera_distance", "markers", "unit")
