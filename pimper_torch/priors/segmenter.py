"""Silhouettes from a network that finds the salient object of a photograph."""

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.priors.from_maps import padded, silhouettes_from
from pimper_torch.priors.network import Picture, onnx_session
from pimper_torch.priors.salient_networks import (
    DEFAULT,
    network_file,
    network_identity,
    rembg_session,
    require_network,
)
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import SilhouettePrior, Views
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.progress import track
from pimper_torch.store import Store, digest, kept, opened

Saliency = Float[Tensor, "height width"]

# The networks' inputs are smaller; maps of this size use 4 MB.
_LARGEST_PX = 1024

# Mean and standard deviation of the training images of U2-Net (Qin et al. 2020) and of IS-Net
# (Qin et al. 2022), the second for inputs of 1024 x 1024, as in rembg.
_IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_ISNET = ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0))


@torch.no_grad()
def segment(
    views: Views, network: Path | str = DEFAULT, *, cache: Store | Path | str | None = None
) -> SilhouettePrior:
    """Make soft masks of photographs by a salient-object network.

    Reports progress. Warns if rembg will download the network.

    Args:
        network: Name of a network of rembg (extra ``segment``), such as ``u2net``,
            ``isnet-general-use`` or ``birefnet-general``; ``rembg`` is ``u2net``. Or an ONNX file
            that works like U2-Net or IS-Net: its first output is the saliency, from 0 to 1, of an
            sRGB image with mean and deviation of ImageNet, or of 0.5 and 1 if its input is
            1024 x 1024.
        cache: Folder in which the map of a photograph is kept, for later calls with the same
            photograph and network.

    Raises:
        InputError: The file is missing, is not ONNX or such a network, or the download failed.
        ConfigError: A package is not installed, or rembg has no network of this name.
    """
    network, store = str(network), opened(cache)
    require_network(network)
    identity, path = network_identity(network), network_file(network)
    predict = _by_rembg(network) if path is None else _by_file(path)

    def found(view: int) -> SilhouettePrior:
        width, height = views.sizes_px[view].tolist()
        image = views.images[view, :, :height, :width].detach()
        key = digest("saliency 1", identity, image)
        return kept(store, key, SilhouettePrior, lambda: _silhouette(predict, image))[0]

    indices = range(views.num_views)
    # Large networks of rembg need gigabytes for one photograph.
    records: Iterable[SilhouettePrior] = (
        map(found, track(indices)) if path is None else side_by_side(found, indices)
    )
    maps = [(each.inside[0, ..., None], None) for each in records]
    return silhouettes_from(padded(dict(zip(views.names, maps, strict=True))))


def _silhouette(
    predict: Callable[[Picture], Saliency], image: Float[Tensor, "channel height width"]
) -> SilhouettePrior:
    """Return the record of one photograph, without its name, which may change."""
    picture = srgb_from_linear(image[None].expand(-1, 3, -1, -1)).float()
    scale = _LARGEST_PX / max(image.shape[1:])
    if scale < 1:
        size = [max(1, round(scale * side)) for side in image.shape[1:]]
        picture = interpolate(picture, size, mode="bilinear", antialias=True)
    inside = predict(picture).to(image)
    return silhouettes_from(padded({"photograph": (inside[..., None], None)}))


def _by_rembg(network: str) -> Callable[[Picture], Saliency]:
    session = cache(lambda: rembg_session(network))  # not opened if all maps are kept

    def predict(picture: Picture) -> Saliency:
        levels = (255 * picture[0].clamp(0, 1)).round().byte().movedim(0, -1)
        mask, *_ = session().predict(Image.fromarray(levels.cpu().numpy()))
        return torch.from_numpy(np.asarray(mask, dtype=np.float32) / 255)

    return predict


def _by_file(path: Path) -> Callable[[Picture], Saliency]:
    session = onnx_session(path)
    size = _input_size(path, session)
    mean, std = (
        torch.tensor(values, dtype=torch.float32, device="cpu")[:, None, None]
        for values in (_ISNET if size == (1024, 1024) else _IMAGENET)
    )
    into, out = session.get_inputs()[0].name, session.get_outputs()[0].name

    def predict(picture: Picture) -> Saliency:
        picture = interpolate(picture.cpu(), size, mode="bilinear", antialias=True)
        picture = picture / picture.amax().clamp(min=1e-6)
        try:
            (array,) = session.run([out], {into: ((picture - mean) / std).numpy()})
        except Exception as error:  # onnxruntime has a type for each error
            raise InputError(f"{path}: cannot be run by onnxruntime ({error}).") from error
        return _spread(path, torch.from_numpy(array))

    return predict


def _input_size(path: Path, session: Any) -> tuple[int, int]:  # noqa: ANN401 - onnxruntime's
    """Return height and width of the network's input: that of U2-Net if it accepts any."""
    inputs = [port.shape for port in session.get_inputs()]
    shape = inputs[0]
    if len(inputs) != 1 or len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
        raise InputError(
            f"{path}: has inputs of the shapes {inputs}; needed: a salient-object network with one "
            "input, an image (1, 3, height, width). Call other networks by `pt.priors_of`."
        )
    height, width = shape[2:]
    return (height, width) if isinstance(height, int) and isinstance(width, int) else (320, 320)


def _spread(path: Path, values: Tensor) -> Saliency:
    """Return a network's output, spread from 0 to 1 as in rembg; one half if it is constant."""
    is_map = values.ndim in (3, 4) and values.shape[:-2].numel() == 1
    low, high = (float(end) for end in values.aminmax()) if values.numel() else (0.0, 0.0)
    if not is_map or not -1e-3 <= low <= high <= 1 + 1e-3:
        raise InputError(
            f"{path}: returns {tuple(values.shape)} with values from {low:.3g} to {high:.3g}; "
            "needed: a salient-object network, whose first output is a map (1, 1, height, width) "
            "from 0 to 1. Call other networks by `pt.priors_of`."
        )
    saliency, constant = values.reshape(values.shape[-2:]).float(), high - low < 1e-6  # rounding
    return torch.full_like(saliency, 0.5) if constant else (saliency - low) / (high - low)
