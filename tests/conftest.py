import pytest


def pytest_configure(config: pytest.Config) -> None:
    # Not in pyproject.toml: pytest would import the package to resolve the category before
    # jaxtyping's hook is in place.
    config.addinivalue_line("filterwarnings", "error::pimper_torch.errors.PimperWarning")
