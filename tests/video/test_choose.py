import torch

from pimper_torch.cli.video.choose import Scan, chosen


def scan(way, sharpness=None):
    way = torch.as_tensor(way, dtype=torch.float32)
    sharpness = torch.ones(len(way)) if sharpness is None else sharpness
    return Scan(sharpness=sharpness, way=way)


def test_frames_are_equally_spaced_at_any_speed():
    time = torch.linspace(0, 1, 400)
    found = scan(2 * time**3)  # slow at first
    numbers = chosen(found, 20)
    assert len(numbers) == 20
    steps = found.way[numbers].diff()
    assert steps.min() > 0.4 * 0.1
    assert steps.max() < 1.6 * 0.1
    assert numbers.diff()[0] > 4 * numbers.diff()[-1]


def test_the_sharpest_frame_of_each_interval_is_selected():
    sharpness = torch.full((200,), 0.2)
    sharpness[7::20] = 0.4
    numbers = chosen(scan(torch.arange(200) / 200, sharpness), 10)
    assert numbers.tolist() == list(range(7, 200, 20))


def test_a_static_camera_gives_one_frame():
    way = torch.cat(
        [torch.linspace(0, 0.5, 50), torch.full((200,), 0.5), torch.linspace(0.5, 1, 50)]
    )
    numbers = chosen(scan(way), 10)
    assert ((numbers >= 50) & (numbers < 250)).sum() <= 1
    assert len(numbers) >= 9


def test_duplicate_frames_are_not_selected():
    way = torch.cat([torch.full((30,), place) for place in (0.0, 0.3, 0.7, 1.0)])
    noise = 0.001 * torch.rand(120, generator=torch.Generator().manual_seed(1))
    numbers = chosen(scan((way + noise).cummax(dim=0).values), 12)
    assert (numbers // 30).tolist() == [0, 1, 2, 3]
