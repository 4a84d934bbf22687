"""Plan of every object before anything starts: its arguments, and its expected cost."""

import json
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import accumulate
from pathlib import Path

from PIL import Image

from pimper_torch.cli.batches.objects import Object
from pimper_torch.cli.batches.task import Outcome, Task, is_whole
from pimper_torch.cli.doctor.cost import estimate
from pimper_torch.cli.doctor.findings import available_gb
from pimper_torch.cli.options import check, inputs_of, parse
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.errors import ConfigError, OutputError, PimperError, some

_REPLACES = "--overwrite"
# A try may take so many times the estimate, and an hour in any case: a choice. What a slower
# machine has finished by then is kept for the next try.
_PATIENCE, _LEAST_S = 10.0, 3600.0


def planned_batch(
    objects: Sequence[Object], out: Path, settings: Sequence[str] = (), *, overwrite: bool = False
) -> list[Task | Outcome]:
    """Check every object as ``pimper reconstruct`` would, and estimate what it takes.

    Args:
        settings: Options of ``pimper reconstruct`` for every object; its own come after them.

    Returns:
        A task for each object; its outcome where it is not begun: whole already, or refused.
    """
    out = out.absolute()
    read = cache(lambda words: parse("reconstruct", ["PHOTOS", "-o", "OUT", *words]))

    def one(thing: Object) -> Task | Outcome:
        given = (*settings, *thing.settings)
        own = tuple(word for word in given if word != _REPLACES)
        words = (*own, *((_REPLACES,) if overwrite or own != given else ()))
        photos, target = Path(thing.photos).absolute(), out / thing.name
        try:
            job = replace(read(words), photos=photos, out=target)
            seconds, gigabytes = estimate(*_pixels(photos, job.common.max_size_px))
            task = Task(
                name=thing.name,
                arguments=("reconstruct", str(photos), "-o", str(target), *words, "--json"),
                out=target,
                key=_made_from(own, inputs_of(job)),
                limit_s=max(_LEAST_S, _PATIENCE * seconds),
                mem_gb=gigabytes,
            )
            if is_whole(task):
                return Outcome(name=thing.name, status="kept")
            check(job)
        except ConfigError as error:
            raise ConfigError(f"{thing.where or thing.name}: {error}") from error
        except PimperError as error:
            since = _changes(task) if isinstance(error, OutputError) else ""
            return Outcome(name=thing.name, status="failed", message=f"{error}{since}")
        return task

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # each run warns of its own
        return [one(thing) for thing in objects]


def runs_at_once(gigabytes: Sequence[float]) -> int:
    """Return how many runs fit the free memory and the cores of this machine."""
    most = available_gb()
    together = accumulate(sorted(gigabytes, reverse=True)[: usable_cores()])
    # A fifth is left to what else runs.
    return max(1, sum(most is None or held <= 0.8 * most for held in together))


def _pixels(photos: Path, max_size_px: int) -> tuple[float, int]:
    """Return the megapixels of all photographs by the size of the first, and their number."""
    files = [path for path in sorted(photos.rglob("*")) if path.is_file()]
    for path in files:
        try:
            with Image.open(path) as image:
                width, height = image.size
        except (OSError, Image.DecompressionBombError):
            continue
        shrunk = min(1.0, max_size_px / max(width, height)) if max_size_px else 1.0
        return len(files) * width * height * shrunk**2 / 1e6, len(files)
    return 24.0 * len(files), len(files)  # Pillow reads none of them, as camera raw


def _made_from(words: Sequence[str], inputs: Mapping[str, Path | None]) -> str:
    """List what a result is made from: arguments, and the size and time of every file, as JSON."""
    options = [f"PHOTOS {inputs['PHOTOS']}"]
    for word in words:
        if word.startswith("--"):
            options.append(word)
        else:
            options[-1] += f" {shlex.quote(word)}"
    read = [(name, path) for name, path in inputs.items() if path and name != "--cache"]
    presets = [Path(word) for word in words if word.endswith((".yaml", ".yml"))]
    files = {}
    for name, given in (*read, *(("--preset", path) for path in presets)):
        for path in (given, *sorted(given.rglob("*"))):
            if path.is_file():
                about = path.stat()
                inside = path.relative_to(given if given.is_dir() else given.parent)
                files[f"{inside} ({name})"] = [about.st_size, about.st_mtime_ns]
    return json.dumps({"options": options, "files": files})


def _changes(task: Task) -> str:
    """State in a sentence how what a result was made from differs from what it would be now."""
    try:
        former, now = (json.loads(one) for one in (task.made_from() or task.key, task.key))
        then, files = former["options"], former["files"]
    except (ValueError, TypeError, KeyError):
        return " An earlier version made it, and did not record its settings and files."
    parts = {
        "without": [one for one in then if one not in now["options"]],
        "with": [one for one in now["options"] if one not in then],
        "changed": [one for one, about in now["files"].items() if files.get(one, about) != about],
        "added": [one for one in now["files"] if one not in files],
        "missing": [one for one in files if one not in now["files"]],
    }
    told = "; ".join(f"{how} {some(names)}" for how, names in parts.items() if names)
    return f" Differences since it was made: {told}." if told else ""
