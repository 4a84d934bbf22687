"""Pillow and pycolmap both carry zlib: a PNG can be written whichever the package loads first."""

import subprocess
import sys

WRITE = """
import numpy as np
from PIL import Image
pixels = np.random.default_rng(0).integers(0, 255, (400, 400, 3), dtype=np.uint8)
Image.fromarray(pixels).save({path!r})
print("written")
"""
COLMAP_FIRST = "from pimper_torch.method.sfm.colmap import loaded\nloaded()\n"


def test_a_png_is_written_after_colmap_was_loaded(tmp_path):
    script = COLMAP_FIRST + WRITE.format(path=str(tmp_path / "a.png"))
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (ran.stdout, ran.stderr) == ("written\n", "")


def test_a_script_that_loads_pycolmap_before_pillow_is_warned():
    ran = subprocess.run(
        [
            sys.executable,
            "-c",
            f"import pycolmap\nimport pimper_torch.doors.io.decode\n{COLMAP_FIRST}",
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "Put `import PIL.Image` before `import pycolmap`" in ran.stderr
