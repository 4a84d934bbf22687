"""Scenes with known truth.

:func:`render_scene` photographs one into a folder, frame by frame; :func:`build_scene` and
:func:`render_frame` are its parts. :func:`render_objects` and :func:`render_shape` keep a small
scene in memory.
"""

from pimper_torch.evidence.scenes.compositions import potato_on_table
from pimper_torch.evidence.scenes.config import SceneConfig
from pimper_torch.evidence.scenes.frame import Frame, render_frame
from pimper_torch.evidence.scenes.objects import RECIPES
from pimper_torch.evidence.scenes.render import render_objects, render_shape
from pimper_torch.evidence.scenes.rendered import RenderedScene
from pimper_torch.evidence.scenes.scene import Scene, build_scene
from pimper_torch.evidence.scenes.scene_object import SceneObject
from pimper_torch.evidence.scenes.sensor import SensorConfig
from pimper_torch.evidence.scenes.sparse import sparse_scene
from pimper_torch.evidence.scenes.stage import Stage
from pimper_torch.evidence.scenes.write import render_scene

SCENES = tuple(RECIPES)

__all__ = [
    "SCENES",
    "Frame",
    "RenderedScene",
    "Scene",
    "SceneConfig",
    "SceneObject",
    "SensorConfig",
    "Stage",
    "build_scene",
    "potato_on_table",
    "render_frame",
    "render_objects",
    "render_scene",
    "render_shape",
    "sparse_scene",
]
