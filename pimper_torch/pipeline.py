"""The chain: photographs in, surface out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from torch import nn

from pimper_torch.alignment.align import Align, AlignConfig
from pimper_torch.coarse.adapt import Adapt, AdaptConfig
from pimper_torch.coarse.enclose import Enclose, EncloseConfig
from pimper_torch.coarse.triangulate import Triangulate, TriangulateConfig
from pimper_torch.config import build, find_config, overlay, read_mapping, require
from pimper_torch.errors import caution, held
from pimper_torch.fusion.fuse import Fuse, FuseConfig
from pimper_torch.integration.integrate import Integrate, IntegrateConfig
from pimper_torch.kernels.switch import Kernels, compile_all, using
from pimper_torch.memory import bytes_of, release_memory, require_memory
from pimper_torch.meshing.extract import Extract, ExtractConfig
from pimper_torch.meshing.mend import Mend, MendConfig
from pimper_torch.outlines.outline import Outline, OutlineConfig, masked
from pimper_torch.patches.decompose import Decompose, DecomposeConfig
from pimper_torch.patches.warp import Warp, WarpConfig
from pimper_torch.photometry.factorize import Factorize, FactorizeConfig
from pimper_torch.radiometry import Encoding
from pimper_torch.records import (
    CoarseMesh,
    DepthPatches,
    Mesh,
    Outlines,
    Reconstruction,
    SparseScene,
    Surface,
    SweptPatches,
    Views,
)
from pimper_torch.refinement.refine import Refine, RefineConfig
from pimper_torch.reporting import Observer, Silent, recorded, stage
from pimper_torch.rims.constraints import Rim, Rims
from pimper_torch.rims.contours import RimConfig
from pimper_torch.sfm.reconstruct import Reconstruct, ReconstructConfig
from pimper_torch.streaming import Prepares, photometry_and_heights
from pimper_torch.sweep.sweep import Sweep, SweepConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundsConfig:
    """How often the middle of the chain runs, and on what.

    Attributes:
        scales: Of the photographs, one a round, coarse to fine; 1 is their own size. Without
            any, the published chain runs once: facets one by one, then joined.
        all_round: Whether the coarse mesh is made of what all views see, in place of the
            cloud's triangulation in one reference view.
    """

    scales: tuple[float, ...] = (0.25, 0.5, 1.0)
    all_round: bool = True

    def __post_init__(self) -> None:
        positive = all(scale > 0 for scale in self.scales)
        require(positive, "rounds.scales", self.scales, "above 0 each")


@dataclass(frozen=True, slots=True, kw_only=True)
class PimperConfig:
    """The settings of every stage, in the order they run.

    ``photographs`` is what :func:`~pimper_torch.io.photographs.load_views` takes as ``encoding``.

    Attributes:
        kernels: Whether compiled kernels stand in for torch on the CPU, where no gradients are
            asked for (numba), or nowhere (torch).
        max_memory: That the process may hold, such as 4GB. A run in rounds whose last one would
            take more is refused in its first, with what would be needed; the published chain has
            no such check. Nothing is no limit.
    """

    kernels: Kernels = "numba"
    max_memory: str = ""
    photographs: Encoding = field(default_factory=Encoding)
    rounds: RoundsConfig = field(default_factory=RoundsConfig)
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    outline: OutlineConfig = field(default_factory=OutlineConfig)
    rims: RimConfig = field(default_factory=RimConfig)
    triangulate: TriangulateConfig = field(default_factory=TriangulateConfig)
    enclose: EncloseConfig = field(default_factory=EncloseConfig)
    decompose: DecomposeConfig = field(default_factory=DecomposeConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)
    factorize: FactorizeConfig = field(default_factory=FactorizeConfig)
    integrate: IntegrateConfig = field(default_factory=IntegrateConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    sweep: SweepConfig = field(default_factory=SweepConfig)
    fuse: FuseConfig = field(default_factory=FuseConfig)
    mend: MendConfig = field(default_factory=MendConfig)
    adapt: AdaptConfig = field(default_factory=AdaptConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)

    def __post_init__(self) -> None:
        bytes_of(self.max_memory)


class Pimper(nn.Module):
    """Piecewise reconstruction of an object from many viewpoints under many unknown lights.

    To swap a stage, assign another module that takes and gives the same records:
    ``pimper.factorize = MyFactorize()``. In rounds, patches come a few at a time to a factorization
    that can be called so (:class:`~pimper_torch.streaming.InParts`), and all at once to others.

    Gradients run from photographs, cameras and coarse mesh through every stage after it. Structure
    from motion, how the coarse mesh is found, and what is chosen (views, samples, faces, splits)
    are constants to autograd.

    Source: Sabzevari, Del Bue, Murino: PiMPeR, piecewise dense 3D reconstruction from
    multi-view and multi-illumination images, 2015. The rounds are ours.
    """

    def __init__(
        self,
        config: PimperConfig | None = None,
        observer: Observer | None = None,
        cache: Path | str | None = None,
    ) -> None:
        super().__init__()
        self.config = config = config or PimperConfig()
        self.observer = observer or Silent()
        self.reconstruct: nn.Module = Reconstruct(config.reconstruct, cache)
        self.outline: nn.Module = Outline(config.outline)
        self.rim: nn.Module = Rim(config.rims)
        self.triangulate: nn.Module = Triangulate(config.triangulate)
        self.enclose: nn.Module = Enclose(config.enclose)
        self.decompose: nn.Module = Decompose(config.decompose)
        self.warp: nn.Module = Warp(config.warp)
        self.factorize: nn.Module = Factorize(config.factorize)
        self.integrate: nn.Module = Integrate(config.integrate)
        self.align: nn.Module = Align(config.align)
        self.refine: nn.Module = Refine(config.refine)
        self.sweep: nn.Module = Sweep(config.sweep)
        self.fuse: nn.Module = Fuse(config.fuse)
        self.mend: nn.Module = Mend(config.mend)
        self.adapt: nn.Module = Adapt(config.adapt)
        self.extract: nn.Module = Extract(config.extract)

    def forward(
        self, views: Views, sparse_model: Path | str | None = None, mesh: Mesh | None = None
    ) -> Reconstruction:
        """Reconstruct the surface that the photographs show.

        Args:
            views: Photographs, on the device that everything after structure from motion
                is to run on.
            sparse_model: Folder of a COLMAP model of these photographs, used instead of
                running structure from motion.
            mesh: A rough surface in that model's frame, of any floating-point type, used
                instead of the photographs' own.

        Raises:
            PimperError: What was found at which stage, what was needed, what to do.
        """
        with using(self.config.kernels), recorded(self, self.observer) as report:
            if self.config.kernels == "numba":
                with stage("compile"):  # next to nothing but for the first run of an installation
                    compile_all()
            scene = self.reconstruct(views, sparse_model)
            outlines = self.outline(scene)
            scene = masked(scene, outlines, self.config.outline.margin)
            chain = self._in_rounds if self.config.rounds.scales else self._published
            patches, surface = chain(scene, outlines, mesh)
            found = self.extract(surface)
        return Reconstruction(
            mesh=found,
            scene=scene,
            outlines=outlines,
            coarse=patches.patches.coarse,
            patches=patches,
            report=tuple(report),
        )

    def _published(
        self, scene: SparseScene, outlines: Outlines | None, mesh: Mesh | None
    ) -> tuple[DepthPatches, Surface]:
        """Every facet by itself, then all joined."""
        coarse = self._coarse(scene, outlines, None, mesh)
        patches = self.decompose(coarse, scene.cameras)
        seen = self.warp(scene.views, scene.cameras, patches)
        depths = self.integrate(self.factorize(seen))
        aligned = self.align(depths)
        return aligned, self.refine(aligned)

    def _in_rounds(
        self, scene: SparseScene, outlines: Outlines | None, mesh: Mesh | None
    ) -> tuple[SweptPatches, Surface]:
        """All facets together, coarse to fine: every round registers on the one before."""
        views, cameras = scene.views, scene.cameras
        rims = self.rim(outlines, cameras)
        coarse = self._coarse(scene, outlines, rims, mesh)
        sources = self.warp.prepare(views) if isinstance(self.warp, Prepares) else None
        swept: SweptPatches | None = None
        surface: Surface | None = None
        last = len(self.config.rounds.scales)
        for number, scale in enumerate(self.config.rounds.scales, start=1):
            with held() as cautions:
                if surface is not None:
                    coarse = self.adapt(swept, surface, rims)
                patches = self.decompose(coarse, cameras, surface, scale)
                if number == 1:
                    scales = self.config.rounds.scales
                    require_memory(bytes_of(self.config.max_memory), patches, scale, scales[-1])
                swept = photometry_and_heights(
                    self.warp, self.factorize, self.sweep, views, cameras, patches, sources
                )
                if number == last:
                    sources = None  # as much memory as the photographs themselves
                release_memory()
                surface = self.mend(self.fuse(swept, rims, expected=number == last))
        for message in cautions:
            caution(message, stacklevel=3)
        assert swept is not None  # there is a round at least
        assert surface is not None
        return swept, surface

    def _coarse(
        self,
        scene: SparseScene,
        outlines: Outlines | None,
        rims: Rims | None,
        mesh: Mesh | None,
    ) -> CoarseMesh:
        found: CoarseMesh
        if mesh is not None or self.config.rounds.all_round:
            found = self.enclose(scene, mesh, outlines, rims)
        else:
            found = self.triangulate(scene)
        return found


def load_config(
    name_or_path: str | Path = "default", changes: Mapping[str, object] | None = None
) -> PimperConfig:
    """Read a preset, or a YAML file of one's own, which holds only what differs.

    Args:
        name_or_path: ``"default"``, ``"paper"``, ``"fast"``, or a file.
        changes: Laid over the file, nested by stage like it.

    Raises:
        ConfigError: Names the file, the section and the key, and the nearest valid one.
    """
    path = find_config(name_or_path)
    return build(PimperConfig, overlay(read_mapping(path), changes or {}), str(path))
