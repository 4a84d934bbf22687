"""Compare silhouettes that are found with masks that are known.

Run as ``python benchmarks/silhouettes.py PHOTOS=MASKS [PHOTOS=MASKS ...]``; prints a Markdown
table, one row a folder of photographs. Masks go by the photographs' names; alpha channels serve.
With ``--overlays DIR`` every photograph is written there with its silhouette drawn in.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from pimper_torch.chains.coarse_to_fine import CoarseToFine, CoarseToFineConfig
from pimper_torch.errors import PimperWarning
from pimper_torch.io.photographs import load_views
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.silhouettes.settings import SilhouetteConfig


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", metavar="PHOTOS=MASKS")
    parser.add_argument("--max-size-px", type=int, default=0)
    parser.add_argument("--size-px", type=int, default=SilhouetteConfig().size_px)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--overlays", type=Path)
    options = parser.parse_args()
    say("| photographs | views | reliable | found | worst | CPU s a view |")
    say("|---|--:|--:|--:|--:|--:|")
    config = CoarseToFineConfig(silhouettes=SilhouetteConfig(size_px=options.size_px))
    chain = CoarseToFine(config, cache=options.cache)
    for pair in options.folders:
        photos, _, masks = pair.partition("=")
        scene = chain.placed(load_views(photos, max_size_px=options.max_size_px), None)
        known = known_masks(masks, scene)
        began = time.process_time()
        with warnings.catch_warnings(record=True) as cautions:
            warnings.simplefilter("always", PimperWarning)
            silhouettes = chain.silhouettes(scene)
        seconds = (time.process_time() - began) / scene.views.num_views
        if silhouettes.source == "everything":
            say(f"| {photos} | {scene.views.num_views} | none: {cautions[-1].message} | | | |")
            continue
        overlap = overlaps(silhouettes, known)
        say(
            f"| {photos} | {scene.views.num_views} | {int(silhouettes.reliable.sum())} "
            f"| {overlap.mean():.4f} | {overlap.min():.4f} | {seconds:.2f} |",
        )
        if options.overlays:
            draw(silhouettes, scene, options.overlays / Path(photos).parent.name)


def overlaps(silhouettes: Silhouettes, known: list[Tensor]) -> Tensor:
    """Give the intersection over union of every view."""
    pairs = zip(silhouettes.masks, known, strict=True)
    return torch.stack([(mask & true).sum() / (mask | true).sum() for mask, true in pairs])


def say(line: str) -> None:
    """Print a line of the table."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def known_masks(folder: str, scene: SparseScene) -> list[Tensor]:
    """Read the masks of the registered photographs; distortion is not undone."""
    found = []
    for name, (width, height) in zip(scene.views.names, scene.views.sizes_px.tolist(), strict=True):
        (path,) = (
            path for path in Path(folder).iterdir() if path.name.split("-")[0].split(".")[0]
            == Path(name).stem
        )  # fmt: skip
        picture = Image.open(path)
        alpha = picture.getchannel("A") if "A" in picture.getbands() else picture.convert("L")
        drawn = np.array(alpha.resize((width, height), Image.Resampling.BOX)) > 127
        mask = torch.zeros(scene.views.images.shape[-2:], dtype=torch.bool)
        mask[:height, :width] = torch.from_numpy(drawn)
        found.append(mask)
    return found


def draw(silhouettes: Silhouettes, scene: SparseScene, folder: Path) -> None:
    """Write every photograph with its silhouette in red."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image, mask in zip(
        scene.views.names, scene.views.images, silhouettes.masks, strict=True
    ):
        shown = (255 * srgb_from_linear(image.clamp(0, 1))).byte().permute(1, 2, 0).numpy().copy()
        edge = mask.numpy() ^ np.roll(mask.numpy(), 2, (0, 1))
        shown[edge] = (255, 0, 0)
        Image.fromarray(shown).save(folder / f"{Path(name).stem}.jpg")


if __name__ == "__main__":
    main()
