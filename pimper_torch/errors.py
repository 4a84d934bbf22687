"""What can go wrong, in the caller's words.

Every message says where, what was found, what was needed, and what to do.
"""


class PimperError(Exception):
    """Base of every error this package raises on purpose."""


class InputError(PimperError):
    """Photographs, masks, models or meshes that cannot be used as they are."""


class ConfigError(PimperError):
    """A setting that does not exist or has an impossible value."""


class OutputError(PimperError):
    """Results that cannot be written where they were asked for."""


class ReconstructionError(PimperError):
    """Structure from motion, or a stage after it, found too little to go on."""


class MissingProgramError(ReconstructionError):
    """A program that somebody else wrote is not installed here."""


class PimperWarning(UserWarning):
    """The result is delivered, but something about it should be known."""
