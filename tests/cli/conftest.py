import numpy as np
import pytest
from PIL import Image

from pimper_torch.records import StageReport


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    noise = np.random.default_rng(76).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    for number in range(4):
        Image.fromarray(noise).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def ctrl_c(monkeypatch):
    """Simulate Ctrl-C while a page is served."""
    from pimper_torch.viewer.viewer import Viewer

    def pressed(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "wait", pressed)


@pytest.fixture
def chain(reconstruction, monkeypatch, lit_before):
    """Replace the real chain by one that records its arguments."""
    from pimper_torch.chains.coarse_to_fine import CoarseToFine
    from pimper_torch.cli import run
    from pimper_torch.export import pictures

    class Chain:
        given = None

        def __init__(self, config, observer, cache):
            self.config, self.observer, Chain.cache = config, observer, cache

        def __call__(self, views, sparse_model=None, mesh=None):
            Chain.given = (self.config, views, sparse_model)
            Chain.mesh = mesh
            self.observer.started("warp")
            self.observer.progressed(1, 2)
            self.work()
            self.observer.finished(
                StageReport(name="warp", seconds=1.0, peak_memory_mb=9.0, figures={"samples": 1200})
            )
            return reconstruction

        def finish(self, result, files):
            return CoarseToFine(cache=Chain.cache).finish(result, files)

        def work(self):
            """Do nothing; tests replace it by events in the middle of a run."""

    # Tested in tests/io and tests/viz: half of the time of a run without work.
    for draw in ("draw_overview", "draw_turn"):
        monkeypatch.setattr(pictures, draw, lambda *given: given[-1].write(b"-"))
    monkeypatch.setattr(run, "make_chain", Chain)
    return Chain
