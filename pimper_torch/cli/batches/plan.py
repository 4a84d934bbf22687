"""Plan of a batch before anything starts: arguments and expected cost of every object."""

import json
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import accumulate
from pathlib import Path

from pimper_torch.cli.batches.objects import Object
from pimper_torch.cli.batches.task import Outcome, Task, is_whole
from pimper_torch.cli.doctor.cost import estimate, megapixels_at, working_size
from pimper_torch.cli.doctor.findings import available_gb
from pimper_torch.cli.options import check, inputs_of, parse
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.errors import ConfigError, OutputError, PimperError, some

_REPLACES = "--overwrite"
# Time limit of a try as a multiple of the estimate, and at least an hour; chosen by hand. Stages
# that a slower machine has finished by then are kept for the next try.
_PATIENCE, _LEAST_S = 10.0, 3600.0


def planned_batch(
    objects: Sequence[Object],
    out: Path,
    settings: Sequence[str] = (),
    *,
    overwrite: bool = False,
    limit_s: float = 0,
    mem_gb: float = 0,
) -> list[Task | Outcome]:
    """Check every object as ``pimper reconstruct`` would, and estimate time and memory.

    Args:
        settings: Options of ``pimper reconstruct`` for every object; its own options follow them.
        limit_s: Time limit of a try, like ``mem_gb`` instead of the estimate, if not 0.

    Returns:
        A task for each object; or its outcome, if it is already complete or refused.
    """
    from pimper_torch.io.photographs import photograph_sizes  # slow to import

    out = out.absolute()
    read = cache(lambda words: parse("reconstruct", ["PHOTOS", "-o", "OUT", *words]))

    def plan(item: Object) -> Task | Outcome:
        given = (*settings, *item.settings)
        options = tuple(word for word in given if word != _REPLACES)
        words = (*options, *((_REPLACES,) if overwrite or options != given else ()))
        photos, target = Path(item.photos).absolute(), out / item.name
        try:
            job = replace(read(words), photos=photos, out=target)
            sizes_px = [*photograph_sizes(photos).values()]
            longest, _ = working_size(sizes_px, job.common.max_size_px, mem_gb)
            seconds, gigabytes = estimate(megapixels_at(sizes_px, longest), len(sizes_px))
            if job.common.max_size_px is None:  # memory of other runs must not change it
                words = (*words, "--max-size-px", str(longest))
            task = Task(
                name=item.name,
                arguments=("reconstruct", str(photos), "-o", str(target), *words, "--json"),
                out=target,
                key=_made_from(options, inputs_of(job)),
                limit_s=limit_s or max(_LEAST_S, _PATIENCE * seconds),
                mem_gb=mem_gb or gigabytes,
            )
            if is_whole(task):
                return Outcome(name=item.name, status="kept")
            check(job)
        except ConfigError as error:
            raise ConfigError(f"{item.where or item.name}: {error}") from error
        except PimperError as error:
            changes = _changes(task) if isinstance(error, OutputError) else ""
            return Outcome(name=item.name, status="failed", message=f"{error}{changes}")
        return task

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # each run repeats its warnings
        return [plan(item) for item in objects]


def runs_at_once(gigabytes: Sequence[float]) -> int:
    """Return the number of simultaneous runs that fit the free memory and cores."""
    free = available_gb()
    sums = accumulate(sorted(gigabytes, reverse=True)[: usable_cores()])
    # A fifth is left to other programs.
    return max(1, sum(free is None or total <= 0.8 * free for total in sums))


def _made_from(words: Sequence[str], inputs: Mapping[str, Path | None]) -> str:
    """Return the inputs of a result as JSON: arguments, and size and time of every file."""
    options = [f"PHOTOS {inputs['PHOTOS']}"]
    for word in words:
        if word.startswith("--"):
            options.append(word)
        else:
            options[-1] += f" {shlex.quote(word)}"
    paths = [(name, path) for name, path in inputs.items() if path and name != "--cache"]
    presets = [Path(word) for word in words if word.endswith((".yaml", ".yml"))]
    files = {}
    for name, given in (*paths, *(("--preset", path) for path in presets)):
        for path in (given, *sorted(given.rglob("*"))):
            if path.is_file():
                stat = path.stat()
                inside = path.relative_to(given if given.is_dir() else given.parent)
                files[f"{inside} ({name})"] = [stat.st_size, stat.st_mtime_ns]
    return json.dumps({"options": options, "files": files})


def _changes(task: Task) -> str:
    """Return a sentence with the differences between the inputs of a result and those of a task."""
    try:
        former, now = (json.loads(text) for text in (task.made_from() or task.key, task.key))
        options, files = former["options"], former["files"]
    except (ValueError, TypeError, KeyError):
        return " An earlier version made it, and did not record its settings and files."
    differences = {
        "without": [option for option in options if option not in now["options"]],
        "with": [option for option in now["options"] if option not in options],
        "changed": [file for file, stat in now["files"].items() if files.get(file, stat) != stat],
        "added": [file for file in now["files"] if file not in files],
        "missing": [file for file in files if file not in now["files"]],
    }
    text = "; ".join(f"{kind} {some(names)}" for kind, names in differences.items() if names)
    return f" Differences since it was made: {text}." if text else ""
