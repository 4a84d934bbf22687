"""Rendered scenes of many seeds, in processes."""

import json
import multiprocessing
import os
import signal
import sys
import types
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.export.result_folder.marker import read_marker
from pimper_torch.runtime.config import require, to_mapping
from pimper_torch.runtime.errors import OutputError
from pimper_torch.runtime.progress import report


def render_scenes(
    name_or_path: str | Path,
    folder: Path | str,
    seeds: Sequence[int],
    config: SceneConfig | None = None,
    *,
    processes: int = 2,
    overwrite: bool = False,
) -> dict[Path, bool]:
    """Render a scene for each seed into a folder of its own, with one process for each at a time.

    Finished scenes are skipped, so an interrupted call is continued by the same call. A script that
    calls it needs ``if __name__ == "__main__"``, as its processes import it.

    Args:
        name_or_path: As of :func:`.render_scene`; the scenes of seeds 0 and 1 of ``jar`` are
            ``folder/jar_000000`` and ``folder/jar_000001``.
        overwrite: Render finished scenes again.

    Returns:
        Whether each scene was rendered by this call, in the order of seeds.

    Raises:
        OutputError: A finished scene has other settings.
        PimperError: As of :func:`.render_scene`; other scenes that are finished stay.
    """
    require(processes >= 1, "processes", processes, "at least 1")
    config = SceneConfig() if config is None else config
    wanted = {
        Path(folder) / f"{Path(name_or_path).stem}_{seed:06d}": replace(config, seed=seed)
        for seed in seeds
    }
    needed = {path: overwrite or not _is_finished(path, each) for path, each in wanted.items()}
    left = {path: wanted[path] for path, lacks in needed.items() if lacks}
    work = partial(_render, str(name_or_path), overwrite)
    if not left:
        return needed
    with _workers(min(processes, len(left))) as pool:
        with _without_ctrl_c():
            waiting = [pool.submit(work, path, each) for path, each in left.items()]
        for done, rendered in enumerate(as_completed(waiting), start=1):
            rendered.result()
            report(done, len(waiting))
    return needed


def _render(name: str, overwrite: bool, folder: Path, config: SceneConfig) -> None:
    try:
        render_scene(name, folder, config, processes=1, overwrite=overwrite)
    except SystemExit:  # of `_stop`; the incomplete scene is removed
        os._exit(1)


def _is_finished(folder: Path, config: SceneConfig) -> bool:
    """Return whether a scene is complete; refuse one of other settings."""
    if read_marker(folder) is None:
        return False
    text = (folder / "truth" / "scene.json").read_text(encoding="utf-8")
    settings, wanted = json.loads(text)["settings"], to_mapping(config)
    other = [name for name in wanted if settings.get(name) != json.loads(json.dumps(wanted[name]))]
    if other:
        name = other[0]
        raise OutputError(
            f"{folder}: was rendered with {name} {settings.get(name)}; needed: {wanted[name]}. "
            "Write elsewhere, or replace it with `--overwrite` (`overwrite=True`)."
        )
    return True


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes of one thread each, which an error in the block stops."""
    before = multiprocessing.active_children()
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_prepare)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise OutputError(
            "A process that rendered was killed, probably as memory ran out. Repeat the call with "
            "fewer `--processes` (`processes=`); finished scenes stay."
        ) from error
    except BaseException:
        for child in set(multiprocessing.active_children()).difference(before):
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C, also in processes that start in the block: this one terminates them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    former = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _prepare() -> None:
    signal.signal(signal.SIGTERM, _stop)
    torch.set_num_threads(1)


def _stop(number: int, _: types.FrameType | None) -> None:
    sys.exit(128 + number)
