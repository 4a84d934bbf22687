"""Files of a rendered scene."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.ray_tracing import RenderedFrame
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.export.reports import write_json
from pimper_torch.io.decode import write_deep_png
from pimper_torch.io.version import installed_version
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.runtime.config import to_mapping

FORMAT, FORMAT_VERSION = "pimper_torch rendered scene", 1
_MASKS = ("foreground", "lit", "highlight")


def write_maps(frame: RenderedFrame, path: Path) -> None:
    """Write the maps of a frame as a compressed ``.npz``.

    Depth is float32 as rendered. Normals and albedo are float16, off by at most 0.03 degrees
    and 0.0003; masks are packed, eight pixels per byte, row by row.
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
    """Return the maps that :func:`write_maps` wrote, with unit normals, and masks as booleans."""
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


def write_frame(frame: RenderedFrame, config: SceneConfig, folder: Path, name: str) -> None:
    """Write the photograph, the mask and the maps of a frame; their folders exist."""
    _write_photograph(frame.image, config, folder / "photos" / name)
    mask = Image.fromarray(255 * frame.foreground.numpy().astype(np.uint8))
    mask.save(folder / "masks" / name)
    write_maps(frame, (folder / "truth" / "maps" / name).with_suffix(".npz"))


def _write_photograph(
    image: Float[Tensor, "channel height width"], config: SceneConfig, path: Path
) -> None:
    trailing = image.movedim(0, -1)
    encoded = srgb_from_linear(trailing) if config.encoding == "srgb" else trailing
    if config.bits == 16:
        write_deep_png((65535 * encoded).round().numpy().astype(np.uint16), path)
    else:
        samples = (255 * encoded).round().numpy().astype(np.uint8)
        # Higher compression levels hardly shrink noise further.
        Image.fromarray(samples).save(path, compress_level=1)


def make_folders(folder: Path, names: Sequence[str]) -> None:
    """Make the folders of photographs, masks and maps."""
    for part in ("photos", "masks", "truth/maps"):
        for subfolder in {Path(name).parent for name in names}:
            (folder / part / subfolder).mkdir(parents=True)


def write_report(scene: str, names: Sequence[str], config: SceneConfig, truth: Path) -> None:
    """Write the settings of a scene, with the format and the version."""
    report = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "pimper_torch": installed_version(),
        "scene": scene,
        "names": list(names),
        "settings": to_mapping(config),
    }
    write_json(report, truth / "scene.json", indent=1)
