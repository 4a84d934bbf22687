"""Priors from a network that predicts maps of photographs."""

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.priors import from_maps
from pimper_torch.radiometry import srgb_from_linear
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
    **meaning: Any,  # noqa: ANN401 - depends on the kind of prior
) -> Prior:
    """Run a network on photographs, one at a time, and return its maps as a prior.

    Differentiable in the parameters of a module, which runs in its current mode.

    Args:
        network: A module, or any function, from an image to a map ``1 channel height width`` of
            the complete image at any size; or to a pair of the map and its variance. Or an ONNX
            file, for :func:`from_onnx`.
        views: Photographs, or a scene with undistorted photographs.
        kind: Kind of the maps. ``inliers`` and ``silhouettes`` are probabilities.
        size_px: Width and height to which images are resized; by default they are not.
        linear: Whether the input is linear radiance instead of sRGB, both in [0, 1].
        mean: Subtracted from images, one value for all channels or one each.
        std: Divisor of images after that.
        meaning: Conventions of the prior: ``axes`` and ``error_deg`` of normals, ``inverse``,
            ``along``, ``gauge`` and ``error`` of depth, as in
            :func:`~pimper_torch.priors.prior_files.read_maps.read_normals` and
            :func:`~pimper_torch.priors.prior_files.read_maps.read_depth`; ``error`` of albedo,
            in units of albedo.

    Raises:
        InputError: The file is not ONNX, or the output is not a map of this kind.
        ConfigError: onnxruntime is not installed.
    """
    photographs = views.views if isinstance(views, SparseScene) else views
    means, deviations = (
        photographs.images.new_tensor(list(values))[:, None, None] for values in (mean, std)
    )
    run = network if callable(network) else from_onnx(network)

    def predict(view: int) -> tuple[Tensor, Tensor | None]:
        width, height = photographs.sizes_px[view].tolist()
        picture = photographs.images[view : view + 1, :, :height, :width].expand(-1, 3, -1, -1)
        picture = picture if linear else srgb_from_linear(picture)
        if size_px is not None:
            picture = interpolate(picture, size_px[::-1], mode="bilinear", antialias=True)
        return _map(run((picture - means) / deviations), kind)

    indices = range(photographs.num_views)
    maps = map(predict, indices) if callable(network) else side_by_side(predict, indices)
    maps_by_name = dict(zip(photographs.names, maps, strict=True))
    return _prior(from_maps.padded(maps_by_name, photographs is not views), kind, meaning)


def _map(output: Any, kind: Kind) -> tuple[Tensor, Tensor | None]:  # noqa: ANN401
    """Return a map as ``height width channel``, and its variance."""
    is_pair = isinstance(output, tuple | list) and len(output) <= 2
    values, variance = (
        layer[:, None] if isinstance(layer, Tensor) and layer.ndim == 3 else layer
        for layer in ((*output, None)[:2] if is_pair else (output, None))
    )
    channels = _CHANNELS.get(kind, (1,))
    fits = isinstance(values, Tensor) and values.ndim == 4 and values.shape[1] in channels
    if not fits or not (variance is None or variance.shape == values[:, :1].shape):
        shape = tuple(values.shape) if isinstance(values, Tensor) else type(output).__name__
        raise InputError(
            f"The network returns {shape}; needed for {kind}: a map (1, "
            f"{' or '.join(map(str, channels))}, height, width), or a pair of it and its variance. "
            "Wrap the network in a module that returns this."
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
    valid = maps.values.isfinite().all(dim=-1)
    values = torch.where(valid[..., None], maps.values, 0)
    if kind == "albedo":
        error = meaning.pop("error", torch.nan)
        has_error = error > 0 or bool(maps.variance.isfinite().any())
        require(has_error, "error", error, "above 0, where the network returns no variance")
        variance = from_maps.variance_of(maps, valid, error**2)
        return AlbedoPrior(albedo=values.movedim(-1, 1), variance=variance, **maps.about, **meaning)
    return InlierPrior(probability=values[..., 0], **maps.about, **meaning)


def onnx_session(path: Path) -> Any:  # noqa: ANN401 - onnxruntime's
    """Open an ONNX file, with one thread per image, so that bits do not depend on their number.

    Raises:
        InputError: The file is not ONNX.
        ConfigError: onnxruntime is not installed.
    """
    if path.suffix.lower() != ".onnx":
        raise InputError(
            f"{path}: is not an ONNX file. Files of `torch.export` (.pt2) and `torch.save` contain "
            "pickles, which can run any code when they are loaded. If you trust the file, load it "
            "yourself and pass the module: `torch.export.load(path).module()`."
        )
    if find_spec("onnxruntime") is None:
        raise ConfigError(
            f"{path} needs onnxruntime, which is not installed: pip install 'pimper_torch[onnx]'."
        )
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a type for each error
        raise InputError(f"{path}: cannot be opened by onnxruntime ({error}).") from error


def from_onnx(path: Path | str) -> Network:
    """Load a network from an ONNX file, for :func:`priors_of`; needs the extra ``onnx``.

    Its first output is the map, and an output ``variance`` is the variance; without gradients.
    :func:`priors_of` runs it for several photographs at once if it gets the path instead.

    Raises:
        InputError: The file is not ONNX.
        ConfigError: onnxruntime is not installed.
    """
    session = onnx_session(Path(path))
    (into, *_), outputs = session.get_inputs(), [output.name for output in session.get_outputs()]
    names = [outputs[0], *(name for name in outputs[1:] if name == "variance")]

    def run(picture: Picture) -> list[Tensor]:
        arrays = session.run(names, {into.name: picture.detach().float().cpu().numpy()})
        return [torch.from_numpy(array).to(picture) for array in arrays]

    return run
