"""The truth about one photograph as a file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.evidence.scenes.frame import Frame

MAP_NAMES = ("depth", "normals_world", "albedo", "foreground", "lit", "highlight")
_MASKS = ("foreground", "lit", "highlight")


def write_maps(frame: Frame, path: Path) -> None:
    """Write the maps of a frame as a compressed ``.npz``.

    Depth is float32 as rendered. Normals and albedo are float16, off by at most 0.03 degrees
    and 0.0003; masks are packed, eight pixels a byte, row by row.
    """
    height, width = frame.depth.shape
    np.savez_compressed(
        path,
        size=np.array([width, height]),
        depth=frame.depth.float().numpy(),
        normals_world=frame.normals_world.to(torch.float16).numpy(),
        albedo=frame.albedo.to(torch.float16).numpy(),
        foreground=np.packbits(frame.foreground.numpy(), axis=1),
        lit=np.packbits(frame.lit.numpy(), axis=1),
        highlight=np.packbits(frame.highlight.numpy(), axis=1),
        allow_pickle=False,
    )


def unpack_maps(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return the maps that :func:`write_maps` wrote, normals unit again, masks as booleans."""
    width = int(arrays["size"][0])
    maps = {
        name: torch.from_numpy(
            np.unpackbits(np.asarray(arrays[name]), axis=1, count=width).astype(bool)
        )
        for name in _MASKS
    }
    maps["depth"] = torch.from_numpy(np.asarray(arrays["depth"]))
    normals = torch.from_numpy(np.asarray(arrays["normals_world"])).float()
    maps["normals_world"] = normalize(normals, dim=-1)
    maps["albedo"] = torch.from_numpy(np.asarray(arrays["albedo"])).float()
    return maps
