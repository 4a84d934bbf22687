"""All that a chain determines before its first pass, in named steps."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch

from pimper_torch.chains.running import ChainRun
from pimper_torch.geometry.contours import Contours
from pimper_torch.priors.conventions import resolve_prior_conventions
from pimper_torch.priors.undistort import with_undistorted_priors
from pimper_torch.records import (
    CoarseMesh,
    Failure,
    Mesh,
    PatchSet,
    Record,
    Removal,
    Silhouettes,
    SparseScene,
    StageReport,
    Views,
)
from pimper_torch.records.scene import with_views
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.reporting import stage
from pimper_torch.stages.coarse.given_mesh import prepared as prepared_mesh
from pimper_torch.stages.coarse.mesh_frame import refuse_other_axes
from pimper_torch.stages.sfm.poses import one_view_per_pose, with_poses
from pimper_torch.stages.sfm.sparse_scene import sound
from pimper_torch.stages.sfm.triangulation import FEW_OBSERVED, lacks_points
from pimper_torch.stages.silhouettes.find import FindSilhouettes, masked, of_all_photographs
from pimper_torch.stages.silhouettes.given import refuse_wrong_masks

# The smallest number from which a surface is reconstructed.
_MIN_VIEWS = 3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Prepared(Record):
    """All that a chain determines before its first pass.

    Attributes:
        scene: Cameras, undistorted photographs with their silhouettes as masks, priors with
            resolved conventions, and the point cloud.
        silhouettes: In the photographs of ``scene``.
        contours: In one photograph per pose; in all of ``scene`` if it has no poses.
        coarse: The coarse surface.
        mesh: The given mesh in the scene's frame; ``None`` if none was given.
        patches: Templates for the last scale, the only one then; ``None`` to compute them.
        held_out: Photographs used only to estimate cameras; ``None`` without any.
        decisions: What was decided about cameras, points, poses and held-out photographs,
            and why, as texts; without entries where there was nothing to decide.
        reports: Report of each stage that ran, in order.
        failures: Elements that failed and were skipped.
        left_out: Elements that guards removed or marked as unreliable, in order.
    """

    scene: SparseScene
    silhouettes: Silhouettes
    contours: Contours
    coarse: CoarseMesh
    mesh: Mesh | None = None
    patches: PatchSet | None = None
    held_out: SparseScene | None = None
    decisions: dict[str, str] = field(default_factory=dict)
    reports: tuple[StageReport, ...] = ()
    failures: tuple[Failure, ...] = ()
    left_out: tuple[Removal, ...] = ()


@runtime_checkable
class ObservesPoints(Protocol):
    """A stage ``reconstruct`` that also adds observed points to a scene with given cameras."""

    def with_points(self, scene: SparseScene) -> SparseScene:
        """Return the scene with points that its photographs observe."""


@runtime_checkable
class Preparing(Protocol):
    """The stages and settings of a chain that its preparation uses."""

    reconstruct: Callable[[Views, Path | str | None], SparseScene]
    depth_points: Callable[[SparseScene], SparseScene]
    silhouettes: Callable[[SparseScene], Silhouettes]
    needed: tuple[str, ...]
    hold_out: int

    def references(self) -> Iterable[str]:
        """Return the names of photographs that settings select as reference view."""

    def notify(self, scene: SparseScene, /) -> None:
        """Receive the scene as soon as cameras are known."""

    def first_surface(
        self, run: ChainRun, scene: SparseScene, silhouettes: Silhouettes, mesh: Mesh | None
    ) -> tuple[Contours, CoarseMesh]:
        """Return contours and coarse surface of one photograph per pose."""


def prepare(
    chain: Preparing,
    run: ChainRun,
    views: Views | SparseScene,
    sparse_model: Path | str | None,
    mesh: Mesh | None,
) -> Prepared:
    """Run the steps of a chain before its first pass."""
    located, decisions = locate(chain, run, views, sparse_model, mesh)
    chain.notify(located)
    needed = (*chain.references(), *chain.needed)
    scene, held_out = split_held_out(located, chain.hold_out, needed)
    single = one_view_per_pose(scene, needed)
    outlines = run(chain.silhouettes, single.scene)
    mesh = in_scene(mesh, views, single.scene, outlines)
    scene, silhouettes = of_all_photographs(scene, single, outlines)
    scene = resolve_prior_conventions(scene, silhouettes)
    has_poses = scene.views.poses is not None
    per_pose = masked(single.scene, outlines) if has_poses else scene
    contours, coarse = chain.first_surface(run, per_pose, outlines, mesh)
    if has_poses:
        coarse = coarse.replace(reference=int(single.chosen[coarse.reference]))
        decisions["poses"] = f"one of the photographs of each of {len(single.chosen)} poses"
    if held_out is not None:
        decisions["held out"] = ", ".join(held_out.views.names)
    return Prepared(
        scene=scene,
        silhouettes=silhouettes,
        contours=contours,
        coarse=coarse,
        mesh=mesh,
        held_out=held_out,
        decisions=decisions,
    )


def locate(
    chain: Preparing,
    run: ChainRun,
    views: Views | SparseScene,
    sparse_model: Path | str | None = None,
    mesh: Mesh | None = None,
) -> tuple[SparseScene, dict[str, str]]:
    """Return usable photographs with cameras, points and undistorted priors, and what was decided.

    Raises:
        InputError: Cameras are given twice, or cameras and points contradict the masks.
    """
    if isinstance(views, Views):
        scene = run(chain.reconstruct, views, sparse_model)
        source = "structure from motion" if sparse_model is None else f"given in {sparse_model}"
    elif sparse_model is not None:
        raise InputError(
            f"{type(chain).__name__}: cameras are given twice, with the scene and as the model in "
            f"{sparse_model}; needed: one of the two."
        )
    else:
        scene, source = views, "given"
        if mesh is not None:
            refuse_other_axes(mesh, scene)
        elif isinstance(chain.reconstruct, ObservesPoints):
            scene = chain.reconstruct.with_points(scene)
    decisions = {"cameras": source}
    if mesh is None and scene.cameras.num_views >= 3 and lacks_points(scene, FEW_OBSERVED):
        scene = run(chain.depth_points, scene)
        decisions["points"] = "from depth maps, since features hardly match"
    scene = with_undistorted_priors(with_poses(sound(scene)))
    finder = chain.silhouettes
    if not isinstance(finder, FindSilhouettes) or finder.config.object != "everything":
        refuse_wrong_masks(scene)
    return scene, decisions


def in_scene(
    mesh: Mesh | None,
    views: Views | SparseScene,
    scene: SparseScene,
    silhouettes: Silhouettes,
) -> Mesh | None:
    """Return the given mesh in the scene's frame, cleaned and compared with the scene.

    Args:
        mesh: None is returned unchanged. Given with photographs, in the frame of their cameras'
            model; given with a scene, in its frame.

    Raises:
        InputError: The mesh is not a surface, or is in a different frame.
    """
    if mesh is None:
        return None
    if isinstance(views, Views):
        vertices = mesh.vertices_world.double()
        mesh = mesh.replace(vertices_world=vertices - vertices.new_tensor(scene.offset_world))
    with stage("given_mesh") as report:
        mesh, figures = prepared_mesh(mesh, scene, silhouettes)
        report |= figures
    return mesh


def split_held_out(
    scene: SparseScene, every: int, needed: Iterable[str] = ()
) -> tuple[SparseScene, SparseScene | None]:
    """Split a scene into used views and held-out views, which are every n-th in order of names.

    Args:
        needed: Names, with or without suffix, of views that are never held out.

    Returns:
        Scenes with the complete cloud. Without held-out views, the scene itself and None.
    """
    names, stay = scene.views.names, set(needed)
    ordered = sorted(range(len(names)), key=names.__getitem__)
    chosen = ordered[every - 1 :: every] if every else []
    held = [view for view in chosen if not stay & {names[view], names[view].rsplit(".", 1)[0]}]
    if not held:
        return scene, None
    left = len(names) - len(held)
    needs = f"a number that leaves at least {_MIN_VIEWS} views; it leaves {left}"
    require(left >= _MIN_VIEWS, "hold_out", every, needs)
    out = torch.zeros(len(names), dtype=torch.bool)
    out[held] = True
    return (
        with_views(scene, ~out).replace(unregistered=scene.unregistered),
        with_views(scene, out).replace(unregistered=()),
    )
