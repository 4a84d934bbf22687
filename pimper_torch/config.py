"""Settings: checked when they are made."""

from pimper_torch.errors import ConfigError


def require(ok: bool, field: str, value: object, needed: str) -> None:
    """Refuse an impossible setting.

    Raises:
        ConfigError: Names the field, its value and what was needed.
    """
    if not ok:
        raise ConfigError(f"{field} is {value!r}; needed: {needed}.")
