"""A COLMAP model that the photographs come with."""

from collections.abc import Sequence
from pathlib import Path

import torch

from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.records import Views
from pimper_torch.sfm import colmap
from pimper_torch.sfm.model import SparseModel, match_names
from pimper_torch.sfm.orientation import find_turns
from pimper_torch.sfm.quarter_turns import (
    turned_lens,
    turned_pixels,
    turned_pose,
    turned_size,
    turning,
)


def existing_model(views: Views, folder: Path) -> SparseModel:
    """Read a COLMAP model and put it in the photographs' order, sizes and orientations.

    Args:
        views: Matched by file name; the model's cameras may have been made from photographs of
            another size, and from the pixels that files store where EXIF turns them.
        folder: Of the model.

    Raises:
        ReconstructionError: The model holds fewer than 3 of the photographs.
        InputError: It does not belong to the photographs, or cannot be read.
    """
    model = match_names(colmap.read_model(folder), views.names, folder, views.folder)
    if model.num_views < 3:
        raise ReconstructionError(
            f"The COLMAP model in {folder} holds {model.num_views} of {views.num_views} "
            f"photographs ({', '.join(model.names)}); at least 3 are needed. Use a model that "
            "holds more of them, or leave it out to run structure from motion."
        )
    number = {name: index for index, name in enumerate(views.names)}
    shown = views.take([number[name] for name in model.names])
    return follow_pictures(model, shown, find_turns(model, shown, str(folder)))


def follow_pictures(model: SparseModel, views: Views, turns: Sequence[int]) -> SparseModel:
    """Put a model's cameras and observations into photographs that were resized and turned.

    Maps to a static background begin in the photographs then, and end where they ended.

    Args:
        model: Its pictures have the photographs' shapes once they are turned.
        views: The photographs, in the model's order.
        turns: Clockwise quarters by which each picture is turned in its photograph.
    """
    lenses = []
    cameras: dict[tuple[int, int, int, int], int] = {}
    fresh = 1 + max(lens.camera for lens in model.lenses)
    pixels = torch.empty_like(model.observation_pixels)
    poses = torch.empty_like(model.cam_from_world)
    maps = model.background_from_view.clone()
    for view, (lens, quarters) in enumerate(zip(model.lenses, turns, strict=True)):
        width, height = views.sizes_px[view].tolist()
        size = turned_size(width, height, quarters)
        # Photographs of one camera that were resized or turned differently no longer share it; the
        # first of them keep its number.
        known = {number for number, *_ in cameras}
        if lens.camera not in known:
            cameras[lens.camera, *size, quarters] = lens.camera
        camera = cameras.setdefault((lens.camera, *size, quarters), fresh + len(cameras))
        resized = colmap.rescale_lens(lens, *size).replace(camera=camera)
        lenses.append(turned_lens(resized, quarters))
        scale = pixels.new_tensor([size[0] / lens.width, size[1] / lens.height])
        here = model.observation_view == view
        pixels[here] = turned_pixels(model.observation_pixels[here] * scale, *size, quarters)
        poses[view] = turned_pose(model.cam_from_world[view], quarters)
        if len(maps):
            shown_from_model = turning(*size, quarters) @ torch.diag(homogeneous(scale))
            maps[view] = torch.linalg.solve(shown_from_model.to(maps), maps[view], left=False)
    return model.replace(lenses=tuple(lenses), cam_from_world=poses, observation_pixels=pixels)
