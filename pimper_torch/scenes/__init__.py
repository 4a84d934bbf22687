"""Scenes with known truth."""

from pimper_torch.scenes.bodies import Body
from pimper_torch.scenes.compositions import potato_on_table
from pimper_torch.scenes.photographs import save_masks, save_photographs
from pimper_torch.scenes.render import render_bodies, render_shape
from pimper_torch.scenes.rendered import RenderedScene
from pimper_torch.scenes.sensor import SensorConfig
from pimper_torch.scenes.sparse import sparse_scene

__all__ = [
    "Body",
    "RenderedScene",
    "SensorConfig",
    "potato_on_table",
    "render_bodies",
    "render_shape",
    "save_masks",
    "save_photographs",
    "sparse_scene",
]
