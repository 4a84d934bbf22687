"""Captures of objects, with their truth, to train on; the files beside it are the package's own."""

from pimper_torch.data.captures import Capture, Captures, read_capture

__all__ = ["Capture", "Captures", "read_capture"]
