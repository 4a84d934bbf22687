"""Rendered scenes with ground truth.

:func:`render_scene` renders one into a folder, frame by frame; :func:`build_scene` and
:func:`render_frame` are its parts. :func:`render_objects` and :func:`render_shape` keep a small
scene in memory, and :func:`render_random` a random one. :func:`render_scenes` renders one for each
seed, in processes.
"""

from pimper_bench.scenes.many_scenes import render_scenes
from pimper_bench.scenes.random_captures import RandomCapture, render_random
from pimper_bench.scenes.ray_tracing import RenderedFrame, TracedObjects, render_frame
from pimper_bench.scenes.render_in_memory import (
    RenderedScene,
    potato_on_table,
    render_objects,
    render_shape,
)
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_object import SceneObject
from pimper_bench.scenes.scene_objects import RECIPES
from pimper_bench.scenes.scene_settings import SceneConfig, SensorConfig
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_bench.scenes.whole_scene import Scene, build_scene

SCENES = tuple(RECIPES)

__all__ = [
    "SCENES",
    "RandomCapture",
    "RenderedFrame",
    "RenderedScene",
    "Scene",
    "SceneConfig",
    "SceneObject",
    "SensorConfig",
    "TracedObjects",
    "build_scene",
    "potato_on_table",
    "render_frame",
    "render_objects",
    "render_random",
    "render_scene",
    "render_scenes",
    "render_shape",
    "sparse_scene",
]
