"""Lines that a type checker must refuse; each would pass with a plain ``torch.nn.Module``."""

import pimper_torch as pt


class Wrong(pt.Stage):
    def forward(self, seen: str) -> pt.PhotometricPatches:
        raise NotImplementedError


def refused(chain: pt.CoarseToFine, scene: pt.SparseScene) -> None:
    chain.factorize("nonsense", 3)  # type: ignore[arg-type]
    chain.factorize = Wrong()  # type: ignore[assignment]
    pt.Factorize()("nonsense", 3)  # type: ignore[arg-type]
    pt.Warp()(scene)  # type: ignore[call-arg, arg-type]
    result = chain(scene)
    result.mesh.vertices  # type: ignore[attr-defined]  # noqa: B018
