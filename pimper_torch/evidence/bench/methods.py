"""Presets and baselines under one signature: sparse scene and coarse mesh in, estimate out."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

from pimper_torch.chains.presets import load_config, make_chain
from pimper_torch.errors import ConfigError
from pimper_torch.evidence.baselines.openmvs import OpenMvs
from pimper_torch.evidence.baselines.smoothed import Smoothed
from pimper_torch.io.estimates import estimate_of
from pimper_torch.records import (
    CoarseMesh,
    Estimate,
    Record,
    SparseScene,
)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Outcome(Record):
    """A method's estimate, and its cost.

    Attributes:
        seconds: Wall clock without structure from motion.
        mesh_points: Vertices of the coarse mesh; ``None`` for methods that use none.
        samples: Samples of all templates times views, missing ones included.
        external: A program of its own did the work, whose memory is not this process's.
    """

    estimate: Estimate
    seconds: float
    mesh_points: int | None = None
    triangles: int | None = None
    samples: int | None = None
    missing_fraction: float | None = None
    external: bool = False


Method = Callable[[SparseScene, CoarseMesh], Outcome]

_BASELINES: dict[str, Callable[[], nn.Module]] = {"smoothed": Smoothed, "openmvs": OpenMvs}


def method_named(name: str) -> Method:
    """Find a baseline by name, or a preset, or a YAML file of settings."""
    if name in _BASELINES:
        return _baseline(_BASELINES[name]())
    try:
        return _preset(name)
    except ConfigError as error:
        raise ConfigError(
            f"method {name!r}: {error} Baselines are {', '.join(_BASELINES)}."
        ) from error


def _preset(name: str) -> Method:
    config = load_config(name)

    def run(scene: SparseScene, coarse: CoarseMesh) -> Outcome:
        chain = make_chain(config)
        began = time.perf_counter()
        result = chain(scene)
        seconds = time.perf_counter() - began
        found = {key: value for report in result.report for key, value in report.figures.items()}
        return Outcome(
            estimate=estimate_of(result),
            seconds=seconds,
            mesh_points=int(found["mesh_points"]),
            triangles=int(found["triangles"]),
            samples=int(found["samples"]),
            missing_fraction=float(found["missing_fraction"]),
        )

    return run


def _baseline(module: nn.Module) -> Method:
    def run(scene: SparseScene, coarse: CoarseMesh) -> Outcome:
        began = time.perf_counter()
        estimate = module(scene, coarse)
        return Outcome(
            estimate=estimate,
            seconds=time.perf_counter() - began,
            external=isinstance(module, OpenMvs),
        )

    return run
