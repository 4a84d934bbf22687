import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stand_ins import CHILD

from pimper_torch.cli.batches import task
from pimper_torch.cli.batches.many_objects import batch


@dataclass
class World:
    """Objects with small programs as runs."""

    folder: Path
    heard: list = field(default_factory=list)

    def add(self, name: str, program: str = "end()") -> Path:
        photos = self.folder / "scans" / name
        photos.mkdir(parents=True)
        noise = np.random.default_rng(76).integers(0, 256, (9, 12, 3), dtype=np.uint8)
        for number in range(4):
            Image.fromarray(noise).save(photos / f"{number}.png")
        (photos / "program.txt").write_text(program)
        return photos

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def batch(self, **options):
        """Run the batch, and return the outcomes by object name."""
        found = batch(self.folder / "scans", self.out, listener=self.heard.append, **options)
        return {one.name: one for one in found}

    def statuses(self, **options) -> dict[str, str]:
        return {name: one.status for name, one in self.batch(**options).items()}

    def begun(self, name: str) -> int:
        """Count how often an object's program was started."""
        path = self.out / f"{name}.begun"
        return len(path.read_text()) if path.exists() else 0


@pytest.fixture
def world(tmp_path, monkeypatch):
    assert sys.platform == "linux"
    monkeypatch.setattr(task, "_CHILD", CHILD)
    monkeypatch.setattr(task, "_TRIES", 2)
    monkeypatch.setattr(task, "_LOOK_SECONDS", 0.05)
    monkeypatch.setattr(task, "_PATIENCE_SECONDS", 0.3)
    monkeypatch.setattr(task, "_END_SECONDS", 0.3)
    return World(tmp_path)
