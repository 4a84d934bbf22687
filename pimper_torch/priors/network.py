"""Guesses of a network about photographs."""

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.priors import from_maps
from pimper_torch.records import AlbedoPrior, InlierPrior, Prior, SparseScene, Views
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ConfigError, InputError
from pimper_torch.runtime.parallel import side_by_side

Picture = Float[Tensor, "1 channel height width"]
Network = Callable[[Picture], Any]
Kind = Literal["normals", "depth", "albedo", "inliers", "silhouettes"]
_CHANNELS: dict[Kind, tuple[int, ...]] = {"normals": (3,), "albedo": (1, 3)}  # others have one


def priors_of(
    network: Network | Path | str,
    views: Views | SparseScene,
    kind: Kind,
    *,
    size_px: tuple[int, int] | None = None,
    linear: bool = False,
    mean: Iterable[float] = (0.0,),
    std: Iterable[float] = (1.0,),
    **meaning: Any,  # noqa: ANN401 - those of whichever prior it becomes
) -> Prior:
    """Run a network over photographs, one at a time, and return its guesses as a prior.

    Differentiable in the parameters of a module, which runs in the mode that it is in.

    Args:
        network: A module, or any function, from a picture to a map ``1 channel height width``
            of the whole picture at any size; or to a pair of the map and its variance. Or an
            ONNX file, whose first output is the map, and one called ``variance`` its variance.
        views: Photographs, or a scene's undistorted ones.
        kind: Of the guesses. ``inliers`` and ``silhouettes`` are probabilities.
        size_px: Width and height that pictures are resized to; their own unless given.
        linear: Whether the network takes linear radiance rather than sRGB, both in [0, 1].
        mean: That is subtracted, one for all channels or one each.
        std: That pictures are divided by then.
        meaning: What else the prior has to state: of normals ``axes`` and ``error_deg``, of depth
            ``inverse``, ``along``, ``gauge`` and ``error``, as
            :func:`~pimper_torch.priors.prior_files.read_maps.read_normals` and
            :func:`~pimper_torch.priors.prior_files.read_maps.read_depth` take them; of albedo
            ``error``, in its own units.

    Raises:
        InputError: The file is of another kind, or the network returns something else.
        ConfigError: onnxruntime is not installed.
    """
    photographs = views.views if isinstance(views, SparseScene) else views
    means, deviations = (
        photographs.images.new_tensor(list(part))[:, None, None] for part in (mean, std)
    )
    run = network if callable(network) else _loaded(Path(network))

    def guess(view: int) -> tuple[Tensor, Tensor | None]:
        width, height = photographs.sizes_px[view].tolist()
        picture = photographs.images[view : view + 1, :, :height, :width].expand(-1, 3, -1, -1)
        picture = picture if linear else srgb_from_linear(picture)
        if size_px is not None:
            picture = interpolate(picture, size_px[::-1], mode="bilinear", antialias=True)
        return _map(run((picture - means) / deviations), kind)

    numbers = range(photographs.num_views)
    guesses = map(guess, numbers) if callable(network) else side_by_side(guess, numbers)
    found = dict(zip(photographs.names, guesses, strict=True))
    return _prior(from_maps.stacked(found, photographs is not views), kind, meaning)


def _map(found: Any, kind: Kind) -> tuple[Tensor, Tensor | None]:  # noqa: ANN401
    """Return a map as ``height width channel``, and its variance."""
    several = isinstance(found, tuple | list) and len(found) <= 2
    values, variance = (
        one[:, None] if isinstance(one, Tensor) and one.ndim == 3 else one
        for one in ((*found, None)[:2] if several else (found, None))
    )
    channels = _CHANNELS.get(kind, (1,))
    fits = isinstance(values, Tensor) and values.ndim == 4 and values.shape[1] in channels
    if not fits or not (variance is None or variance.shape == values[:, :1].shape):
        shape = tuple(values.shape) if isinstance(values, Tensor) else type(found).__name__
        raise InputError(
            f"The network returns {shape}; needed for {kind}: a map (1, "
            f"{' or '.join(map(str, channels))}, height, width), or a pair of it and its variance. "
            "Wrap it in a module that returns this."
        )
    return values[0].movedim(0, -1), None if variance is None else variance[0, 0]


def _prior(maps: from_maps.Maps, kind: Kind, meaning: dict[str, Any]) -> Prior:
    makers: dict[Kind, Callable[..., Prior]] = {
        "normals": from_maps.normals_from,
        "depth": from_maps.depth_from,
        "silhouettes": from_maps.silhouettes_from,
    }
    if kind in makers:
        return makers[kind](maps, **meaning)
    known = maps.values.isfinite().all(dim=-1)
    values = torch.where(known[..., None], maps.values, 0)
    if kind == "albedo":
        error = meaning.pop("error", torch.nan)
        told = error > 0 or bool(maps.variance.isfinite().any())
        require(told, "error", error, "above 0, where the network returns no variance")
        variance = from_maps.variance_of(maps, known, error**2)
        return AlbedoPrior(albedo=values.movedim(-1, 1), variance=variance, **maps.about, **meaning)
    return InlierPrior(probability=values[..., 0], **maps.about, **meaning)


def _loaded(path: Path) -> Network:
    """Open an ONNX file; one thread a picture, so that bits do not depend on their number."""
    if path.suffix.lower() != ".onnx":
        raise InputError(
            f"{path}: is no ONNX file. Files of `torch.export` (.pt2) and of `torch.save` hold "
            "pickles, which may run any program when they are loaded. If you trust it, load it "
            "yourself and give the module: `torch.export.load(path).module()`."
        )
    if find_spec("onnxruntime") is None:
        raise ConfigError(
            f"{path} needs onnxruntime, which is not installed: pip install 'pimper_torch[onnx]'."
        )
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # its own kinds, one for each fault
        raise InputError(f"{path}: cannot be opened by onnxruntime ({error}).") from error
    (into, *_), outputs = session.get_inputs(), [one.name for one in session.get_outputs()]
    wanted = [outputs[0], *(name for name in outputs[1:] if name == "variance")]

    def run(picture: Picture) -> list[Tensor]:
        found = session.run(wanted, {into.name: picture.detach().float().cpu().numpy()})
        return [torch.from_numpy(one).to(picture) for one in found]

    return run
