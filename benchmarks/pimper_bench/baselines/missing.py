"""The error of a baseline whose program is missing."""

from pimper_torch.runtime.errors import ReconstructionError


class MissingProgramError(ReconstructionError):
    """An external program is not installed."""
