import pytest
import torch

from pimper_torch.records import Silhouettes
from pimper_torch.stages.silhouettes.find import by_session


@pytest.fixture
def numbers(staged):
    """Return a function from the scene of a capture session to the numbers of its views."""
    names = staged.scene.views.names
    return lambda part: [names.index(name) for name in part.views.names]


def numbered(part, views):
    """Return silhouettes with the number of each view as value."""
    inside = torch.tensor(views).float()[:, None, None] * torch.ones_like(part.views.images[:, 0])
    return Silhouettes(inside=inside, reliable=torch.tensor(views) > 2, source="found")


def test_silhouettes_of_sessions_are_in_the_order_of_views(staged, numbers):
    scene = staged.scene
    count = scene.views.num_views
    sessions = torch.arange(count) % 2
    asked = []

    def find(part):
        assert len(part.sessions) == 0
        asked.append(numbers(part))
        found = numbered(part, numbers(part))
        return found.replace(hidden=found.inside > 0) if 0 in numbers(part) else found

    found = by_session(scene.replace(sessions=sessions), find)
    assert asked == [list(range(0, count, 2)), list(range(1, count, 2))]
    assert found.inside[:, 0, 0].tolist() == list(range(count))
    assert found.reliable.tolist() == [view > 2 for view in range(count)]
    assert found.source == "found"
    assert found.hidden[:, 0, 0].tolist() == [view > 0 and view % 2 == 0 for view in range(count)]


def test_without_sessions_all_views_are_processed_together(staged, numbers):
    scene = staged.scene
    found = by_session(scene, lambda part: numbered(part, numbers(part)))
    assert found.inside[:, 0, 0].tolist() == list(range(scene.views.num_views))


def test_one_session_without_silhouettes_discards_all(staged, numbers):
    scene = staged.scene

    def find(part):
        views = numbers(part)
        return numbered(part, views) if 0 in views else Silhouettes.everything(part.views)

    sessions = torch.arange(scene.views.num_views) % 2
    found = by_session(scene.replace(sessions=sessions), find)
    assert found.source == "everything"
    assert len(found.inside) == scene.views.num_views


def test_everything_is_bounded_by_the_planes_of_all_sessions(staged, numbers):
    scene = staged.scene
    sessions = torch.arange(scene.views.num_views) % 2

    def find(part):
        plane = torch.tensor([[0.0, 0.0, 1.0, float(numbers(part)[0])]])
        return Silhouettes.everything(part.views, plane)

    found = by_session(scene.replace(sessions=sessions), find)
    assert found.planes_world[:, 3].tolist() == [0.0, 1.0]
