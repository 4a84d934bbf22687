import pytest


@pytest.fixture
def viewer():
    """An empty page on a free port."""
    pytest.importorskip("viser")
    from pimper_torch.result.viewer.viewer import opened

    with opened(port=0) as viewer:
        yield viewer
