"""HEIC files of 64 x 48 pixels, made by pillow_heif 1.8.1, which writes them; pi_heif reads alone.

Red is 40 + 3u, green 60 + 3v, blue 60 + u + v, of 255, before the file's rotation.
"""

from pathlib import Path

# 8 bits, to be turned right by itself and by EXIF, 35 mm equivalent of 50, Display P3.
UPRIGHT = Path(__file__).with_name("upright.heic").read_bytes()
# 10 bits, sRGB.
DEEP = Path(__file__).with_name("deep.heic").read_bytes()
