import subprocess
import sys

SCRIPT = """
import os, signal
from pimper_torch.method.sfm.colmap import quiet

def interrupt(number, frame):
    raise KeyboardInterrupt

signal.signal(signal.SIGTERM, interrupt)
with quiet():
    pass
try:
    os.kill(os.getpid(), signal.SIGTERM)
except KeyboardInterrupt:
    print("cleaned up")
"""


def test_a_polite_kill_still_cleans_up_once_colmap_is_loaded():
    ran = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert ran.stdout == "cleaned up\n", ran.stderr
