"""Log every record of a run, use a stage of one's own, plot one patch."""

import logging
import sys

import torch

import pimper_torch as pt


class WithoutHighlights(pt.Stage):
    """The gauge of the package, with albedo clamped to the 0.9 quantile of the samples."""

    def __init__(self) -> None:
        super().__init__()
        self.gauge = pt.stages.FixGauge()

    def forward(self, solved: pt.PhotometricPatches) -> pt.PhotometricPatches:
        found = self.gauge(solved)
        limit = torch.cat([bucket.albedo[bucket.valid].flatten() for bucket in found.buckets])
        most = float(limit.quantile(0.9))
        held = [bucket.replace(albedo=bucket.albedo.clamp_max(most)) for bucket in found.buckets]
        return found.replace(buckets=tuple(held))


def main(scene: pt.SparseScene, mesh: pt.Mesh, picture: str) -> None:
    chain = pt.load_chain("default", {"scales": [0.5, 1.0]}, gauge=WithoutHighlights())
    for step in chain.steps(scene, mesh=mesh):
        for record in (step.scene, step.coarse, step.photometric, step.heights, step.surface):
            logging.getLogger("run").info("%s: %s", step.scale, record)
    pt.plot_patch(step.heights[17]).savefig(picture)


if __name__ == "__main__":
    placed = pt.load_record(pt.SparseScene, sys.argv[1])
    main(placed, pt.load_record(pt.Mesh, sys.argv[2]), sys.argv[3])
