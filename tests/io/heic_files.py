"""HEIC files of 64 x 48 pixels, written by pillow_heif 1.8.1: pi_heif only reads."""

from pathlib import Path

import numpy as np

# 8 bits, rotated by its own property and by EXIF, 35 mm equivalent of 50, Display P3.
UPRIGHT = Path(__file__).with_name("upright.heic").read_bytes()
# 10 bits, sRGB.
DEEP = Path(__file__).with_name("deep.heic").read_bytes()

# The image in both files before rotation.
V, U = np.mgrid[:48, :64]
STORED = np.stack([40 + 3 * U, 60 + 3 * V, 60 + U + V], axis=-1).astype(np.uint8)
