import pytest

from pimper_torch.records import Cameras
from tests.rims.shapes import all_round


@pytest.fixture(scope="session")
def cameras() -> Cameras:
    return all_round()
