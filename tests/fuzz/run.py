"""Damaged files to every reader: each must give a clean error or a sound result.

``python tests/fuzz/run.py --count 20000 --seed 0 --report fuzz.jsonl``

Every file is read in a forked worker that may take 2 GB more than it began with and 20 s. What is
accepted: a :class:`~pimper_torch.runtime.errors.PimperError` in words of the package, or a result
whose values are finite and whose indices exist. What is not: any other exception, an ended or
hanging process, more memory, files opened outside of the folder, pickles, and text of a library's
source in a message. The report has a line a failure, and the file that made it is kept beside it.
"""

import argparse
import json
import multiprocessing
import os
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from random import Random

import torch

sys.path.insert(0, str(Path(__file__).parent))
from mutations import mutated
from seeds import Seed, make_seeds

from pimper_torch.ground.geometry.colmap_library import loaded
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.records import Record
from pimper_torch.runtime.errors import PimperError

LIMIT_BYTES, LIMIT_SECONDS = 2 * 2**30, 20.0
# Of libraries' sources and memory, which say nothing to a reader.
_FOREIGN = re.compile(r"Check failed|\.(?:cc|cpp|h|rs)\b|std::|0x[0-9a-f]{6}|object at|Traceback")
_SYSTEM = tuple({sys.prefix, sys.base_prefix, "/proc", "/dev", "/sys", "/usr", "/lib"})
_PACKAGE = str(Path(__file__).resolve().parents[2])


@dataclass(frozen=True)
class Case:
    """One damaged file."""

    number: int
    seed: str
    file: str
    mutation: str
    problem: str = ""
    seconds: float = 0.0


def main() -> int:
    """Run, print a summary, and give 1 where anything failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", default="", help="seeds whose names contain this")
    parser.add_argument("--report", type=Path, default=None, help="a JSON line for each failure")
    given = parser.parse_args()
    torch.set_num_threads(1)
    loaded()
    kept = None if given.report is None else given.report.with_suffix(".files")
    with tempfile.TemporaryDirectory() as folder:
        seeds = [seed for seed in make_seeds(Path(folder) / "seeds") if given.only in seed.name]
        begin = time.monotonic()
        failed: list[Case] = []
        for case in run(seeds, given.seed, given.count, given.workers, Path(folder), kept):
            if case.problem:
                failed.append(case)
                line = json.dumps(case.__dict__)
                if given.report is None:
                    sys.stdout.write(f"{line}\n")
                else:
                    with given.report.open("a", encoding="utf-8") as file:
                        file.write(f"{line}\n")
    kinds = Counter((case.seed, case.problem.splitlines()[-1][:90]) for case in failed)
    for (seed, problem), count in kinds.most_common():
        sys.stdout.write(f"{count:5d}  {seed}: {problem}\n")
    seconds = time.monotonic() - begin
    sys.stdout.write(f"{given.count} files, {len(failed)} failures, {seconds:.0f} s\n")
    return 1 if failed else 0


def run(
    seeds: list[Seed], seed: int, count: int, workers: int, folder: Path, kept: Path | None
) -> Iterator[Case]:
    """Hand numbers to workers, end those that hang, and replace those that died."""
    context = multiprocessing.get_context("fork")
    pool: dict[Connection, tuple[multiprocessing.Process, int, float]] = {}
    numbers = iter(range(count))

    def start() -> tuple[Connection, multiprocessing.Process]:
        ours, theirs = context.Pipe()
        others = [*pool, ours]
        process = context.Process(
            target=_work, args=(theirs, others, seeds, seed, folder, kept), daemon=True
        )
        process.start()
        theirs.close()
        return ours, process  # type: ignore[return-value]

    def hand(connection: Connection, process: multiprocessing.Process) -> None:
        number = next(numbers, None)
        connection.send(number)
        if number is None:
            process.join()
        else:
            pool[connection] = (process, number, time.monotonic())

    for _ in range(workers):
        hand(*start())
    while pool:
        for connection in wait(list(pool), timeout=1.0):
            assert isinstance(connection, Connection)
            process, number, since = pool.pop(connection)
            try:
                yield connection.recv()
                hand(connection, process)
            except (EOFError, ConnectionResetError):
                process.join()
                yield _lost(seeds, seed, number, f"the process ended with {process.exitcode}")
                hand(*start())
        for connection, (process, number, since) in list(pool.items()):
            if time.monotonic() - since > LIMIT_SECONDS:
                process.kill()
                process.join()
                del pool[connection]
                yield _lost(seeds, seed, number, f"took more than {LIMIT_SECONDS:.0f} s")
                hand(*start())


def damage(seeds: list[Seed], seed: int, number: int) -> tuple[Seed, str, str, bytes]:
    """Make the file of a number: always the same."""
    random = Random(f"{seed} {number}")
    chosen = seeds[number % len(seeds)]
    file = random.choice(chosen.files)
    data = (chosen.folder / file).read_bytes()
    mutation, data = mutated(data, Path(file).suffix, random)
    return chosen, file, mutation, data


def _lost(seeds: list[Seed], seed: int, number: int, problem: str) -> Case:
    chosen, file, mutation, _ = damage(seeds, seed, number)
    return Case(number, chosen.name, file, mutation, problem)


_opened: list[str] = []


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        _opened.append(os.fsdecode(arguments[0]))
    elif event == "pickle.find_class":
        _opened.append(f"pickle of {arguments}")


def _work(
    connection: Connection,
    others: list[Connection],
    seeds: list[Seed],
    seed: int,
    folder: Path,
    kept: Path | None,
) -> None:
    for other in others:
        other.close()
    warnings.simplefilter("ignore")
    with Path("/proc/self/statm").open() as file:
        held = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + LIMIT_BYTES + 2**28,) * 2)
    sys.addaudithook(_watch)
    home = folder / f"worker{os.getpid()}"
    home.mkdir()
    (home / "outside.png").write_bytes(b"")
    # What libraries print when they abort is no one's to read.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    while (number := connection.recv()) is not None:
        connection.send(_tried(seeds, seed, number, home, kept))


def _tried(seeds: list[Seed], seed: int, number: int, home: Path, kept: Path | None) -> Case:
    chosen, file, mutation, data = damage(seeds, seed, number)
    copy = home / "case" / "in"
    shutil.rmtree(copy.parent, ignore_errors=True)
    shutil.copytree(chosen.folder, copy)
    (copy / file).write_bytes(data)
    _opened.clear()
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    begin = time.monotonic()
    try:
        problem = unsound(chosen.read(copy))
    except PimperError as error:
        foreign = _FOREIGN.search(str(error).replace(str(copy), ""))
        problem = f"message: {str(error)[:900]}" if foreign else ""
    except BaseException:
        problem = traceback.format_exc()[-1500:]
    seconds = time.monotonic() - begin
    taken = _resident("VmHWM") - before
    if taken > LIMIT_BYTES:
        problem = problem or f"took {taken / 2**30:.1f} GB"
    outside = [path for path in _opened if not _inside(path, copy)]
    if outside:
        problem = problem or f"opened {outside[:3]}"
    if problem and kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        (kept / f"{number}-{Path(file).name}").write_bytes(data)
    return Case(number, chosen.name, file, mutation, problem, round(seconds, 2))


def _resident(field: str) -> int:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * int(text.split(f"{field}:")[1].split()[0])


def _inside(path: str, copy: Path) -> bool:
    if path.startswith("pickle"):
        return False
    whole = os.path.realpath(path)
    return (
        whole.startswith((str(copy.resolve()), *_SYSTEM, _PACKAGE)) or not Path(path).is_absolute()
    )


def unsound(result: object, where: str = "result") -> str:
    """Tell what is wrong with a result; nothing where it is sound."""
    if isinstance(result, SparseModel):
        poses, points = result.cam_from_world, result.points_world
        if not bool(poses.isfinite().all()) or not bool(points.isfinite().all()):
            return f"{where}: poses or points are not finite"
        rotation = poses[:, :3, :3]
        off = rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype)
        if len(poses) and float(off.abs().max()) > 1e-3:
            return f"{where}: poses are not rigid"
        for index, count in (
            (result.observation_point, len(points)),
            (result.observation_view, result.num_views),
        ):
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < count:
                return f"{where}: indices out of range"
        if not bool(result.observation_pixels.isfinite().all()):
            return f"{where}: pixels are not finite"
        for lens in result.lenses:
            known = torch.tensor(lens.params, dtype=torch.float64).isfinite().all()
            if not (bool(known) and lens.params[0] > 0 and lens.width > 0 and lens.height > 0):
                return f"{where}: the lens {lens}"
        return ""
    if isinstance(result, Record):
        for fault in result.faults():
            return f"{where}: {fault}"
        for name in type(result).__dataclass_fields__:
            if problem := unsound(getattr(result, name), f"{where}.{name}"):
                return problem
    elif isinstance(result, tuple | list):
        for index, one in enumerate(result):
            if problem := unsound(one, f"{where}[{index}]"):
                return problem
    elif isinstance(result, torch.Tensor) and result.is_floating_point():
        name = where.rpartition(".")[2]
        # Depth is infinite off the object, and focal lengths are NaN where unknown.
        if name not in ("depth", "focals_px") and bool(result.isnan().any()):
            return f"{where}: has NaN"
    return ""


if __name__ == "__main__":
    sys.exit(main())
