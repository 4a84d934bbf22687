import pytest


@pytest.fixture
def viewer():
    """An empty page on a free port."""
    pytest.importorskip("viser")
    from pimper_torch.viewer.viewer import Viewer

    with Viewer(port=0) as viewer:
        yield viewer
