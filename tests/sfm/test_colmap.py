"""COLMAP's library with others: Pillow, which shares its zlib, and signals."""

import subprocess
import sys

SCRIPT = """
import os, signal
import numpy as np
from pimper_torch.geometry.colmap_library import loaded

def interrupt(number, frame):
    raise KeyboardInterrupt

signal.signal(signal.SIGTERM, interrupt)
loaded()
from PIL import Image
pixels = np.random.default_rng(0).integers(0, 255, (400, 400, 3), dtype=np.uint8)
Image.fromarray(pixels).save({path!r})
print("written")
try:
    os.kill(os.getpid(), signal.SIGTERM)
except KeyboardInterrupt:
    print("cleaned up")
"""
WRONG_ORDER = """
import pycolmap
import PIL.Image
from pimper_torch.geometry.colmap_library import loaded
loaded()
"""


def run(script):
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60
    )


def test_with_colmap_loaded_png_is_written_and_sigterm_cleans_up(tmp_path):
    ran = run(SCRIPT.format(path=str(tmp_path / "a.png")))
    assert (ran.stdout, ran.stderr) == ("written\ncleaned up\n", "")


def test_a_script_that_loads_pycolmap_before_pillow_is_warned():
    assert "Put `import PIL.Image` before `import pycolmap`" in run(WRONG_ORDER).stderr
