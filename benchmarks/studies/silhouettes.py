"""Compare estimated silhouettes with given masks.

Run as ``python benchmarks/studies/silhouettes.py PHOTOS=MASKS [PHOTOS=MASKS ...]``; prints a
Markdown table, one row per folder of photographs. Masks have the photographs' names; alpha channels
are accepted. ``--overlays DIR`` writes every photograph with its silhouette drawn in. ``--soft
DIR`` (one per folder of photographs, in their order) uses soft masks of a segmenter like ``pimper
reconstruct --silhouettes``, and also compares them directly: ``raw``.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.chains.prepare import locate
from pimper_torch.io.photographs import load_views
from pimper_torch.priors.prior_files.read_silhouettes import read_silhouettes
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import SilhouettePrior, Silhouettes, SparseScene
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", metavar="PHOTOS=MASKS")
    parser.add_argument("--max-size-px", type=int, default=0)
    parser.add_argument("--size-px", type=int, default=SilhouetteConfig().size_px)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--overlays", type=Path)
    parser.add_argument("--soft", type=Path, nargs="+", default=())
    options = parser.parse_args()
    say("| photographs | views | reliable | raw | worst | found | worst | CPU s a view |")
    say("|---|--:|--:|--:|--:|--:|--:|--:|")
    config = CoarseToFineConfig(silhouettes=SilhouetteConfig(size_px=options.size_px))
    chain = CoarseToFine(config, cache=options.cache)
    for pair, soft in zip_longest(options.folders, options.soft):
        photos, _, masks = pair.partition("=")
        views, raw = load_views(photos, max_size_px=options.max_size_px), "| |"
        if soft:
            views = views.replace(priors=(read_silhouettes(soft, views),))
        scene = locate(chain, chain.running(), views)[0]
        known = known_masks(masks, scene)
        if soft:
            alone = overlaps(soft_masks(scene), known)
            raw = f"| {alone.mean():.4f} | {alone.min():.4f} "
        began = time.process_time()
        with warnings.catch_warnings(record=True) as cautions:
            warnings.simplefilter("always", PimperWarning)
            silhouettes = chain.silhouettes(scene)
        seconds = (time.process_time() - began) / scene.views.num_views
        if silhouettes.source == "everything":
            say(f"| {photos} | {scene.views.num_views} | none: {cautions[-1].message} {raw}| | | |")
            continue
        overlap = overlaps(silhouettes.masks, known)
        say(
            f"| {photos} | {scene.views.num_views} | {int(silhouettes.reliable.sum())} "
            f"{raw}| {overlap.mean():.4f} | {overlap.min():.4f} | {seconds:.2f} |",
        )
        if options.overlays:
            draw(silhouettes, scene, options.overlays / Path(photos).parent.name)


def overlaps(found: Iterable[Tensor], known: list[Tensor]) -> Tensor:
    """Return the intersection over union of every view."""
    pairs = zip(found, known, strict=True)
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


def soft_masks(scene: SparseScene) -> Iterator[Tensor]:
    """Threshold the soft masks of a scene at one half; views without one are empty."""
    prior = scene.views.priors[0]
    assert isinstance(prior, SilhouettePrior)
    for name, (width, height) in zip(scene.views.names, scene.views.sizes_px.tolist(), strict=True):
        mask = torch.zeros(scene.views.images.shape[-2:], dtype=torch.bool)
        if name in prior.names:
            index = prior.names.index(name)
            wide, high = prior.sizes_px[index].tolist()
            inside = prior.inside[index, None, None, :high, :wide]
            small = interpolate(inside, (height, width), mode="bilinear", antialias=True)
            mask[:height, :width] = small[0, 0] > 0.5
        yield mask


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
