"""All stages in one namespace: ``pt.stages.Warp``.

``CoarseToFine`` (presets ``default`` and ``fast``) runs ``Reconstruct``, ``FindSilhouettes``,
``TraceContours``, ``CoarseSurface`` and ``DepthFromLight``; for each scale ``Decompose``, ``Warp``,
``FitLight``, ``Factorize``, ``Sweep``, ``FixGauge``, ``Fuse``, ``Repair`` and ``Remesh``; then
``Extract`` and ``Judge``.
``Chain.finish`` runs ``Simplify``, ``Relight``, ``Texture``, ``JudgeTextures`` and ``Judge``.
"""

import sys

import lazy_loader

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Names that were here in 0.10, and are in the package's namespace.
_FORMER = {
    *("Chain", "CoarseToFine", "CoarseToFineConfig", "Contours", "Published", "PublishedConfig"),
    *("Step", "Triangulate", "load_chain", "load_config", "make_chain"),
}


def __getattr__(name: str) -> object:
    if name in _FORMER:
        from pimper_torch.runtime.former_modules import renamed

        renamed(f"pimper_torch.stages.{name}", f"pimper_torch.{name}")
        return getattr(sys.modules["pimper_torch"], name)
    return _public(name)
