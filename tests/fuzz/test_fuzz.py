"""Damaged files of every kind give a clean error or a valid result, in little memory and time.

Accepted are a :class:`~pimper_torch.runtime.errors.PimperError` in words of the package, or a
result with finite values and valid indices. Failures are any other exception, a process that ends
or hangs, two more gigabytes of memory, files opened outside the folder, pickles, and text of a
library's source in a message.
"""

import faulthandler
import io
import json
import os
import re
import resource
import shutil
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, Phase, given, note, settings
from hypothesis import strategies as st

from pimper_torch.records import Record
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import PimperError
from tests.fuzz.seeds import make_seeds

LIMIT_BYTES, LIMIT_SECONDS = 2 * 2**30, 20
# Text of libraries' sources and memory, meaningless to users.
FOREIGN = re.compile(r"Check failed|\.(?:cc|cpp|h|rs)\b|std::|0x[0-9a-f]{6}|object at|Traceback")
SYSTEM = (sys.prefix, sys.base_prefix, "/proc", "/dev", "/sys", "/usr", "/lib")
PACKAGE = str(Path(__file__).resolve().parents[2])

INTEGERS = (0, 1, -1, 2**7, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63)
DOUBLES = (float("nan"), float("inf"), -float("inf"), -1.0, 1e308, 1e-308, 1e20)
ALIASES = "\n".join(
    ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))]
)
WORDS = (
    *("", "x", "0", "-1", "nan", "inf", "1e308", "1e-320", "2147483648", "9223372036854775808"),
    *("../../outside.png", "/etc/passwd", "..\\outside.png", "a\\u0000b", "C:\\x.png", "~"),
    *("|O", "<c16", "<M8[s]", "<U99", "10**9", "(99999, 99999)", "()"),
    *("[" * 100_000, "[" * 2000 + "]" * 2000, '{"a":' * 2000 + "1" + "}" * 2000, ALIASES),
)
VALUES = st.sampled_from(
    [
        *(None, True, -1, 0, 2**63, 10**400, 0.5, 1e308, *DOUBLES[:3], "\ud800", *WORDS[:16]),
        *([], {}, [[]], [1, [2]], {"a": 1}, ["x"], [None]),
    ]
)
PIECES = st.one_of(
    st.binary(max_size=64),
    st.builds(
        lambda value, length, order: (value % 256**length).to_bytes(length, order),
        st.sampled_from(INTEGERS),
        st.sampled_from((1, 2, 4, 8)),
        st.sampled_from(("little", "big")),
    ),
    st.sampled_from([struct.pack("<d", value) for value in DOUBLES]),
    st.sampled_from([b"\0" * 4096, b"\xff" * 4096]),
)


@st.composite
def damaged(draw, data: bytes) -> bytes:
    """Overwrite bytes anywhere, replace words, or truncate the data."""
    for _ in range(draw(st.integers(1, 4))):
        how = draw(st.sampled_from(("over", "word", "word", "into", "head", "cut")))
        if how == "word":
            words = [*re.finditer(rb"[-+.\w]+", data)]
            if words:
                at = draw(st.sampled_from(words))
                word = draw(st.sampled_from(WORDS)).encode()
                data = data[: at.start()] + word + data[at.end() :]
            continue
        start = draw(st.integers(0, min(96, len(data)) if how == "head" else len(data)))
        piece = b"" if how == "cut" else draw(PIECES)
        gone = {"into": 0, "cut": len(data)}.get(how, len(piece))
        data = data[:start] + piece + data[start + gone :]
    return data


@st.composite
def damaged_inside(draw, data: bytes, suffix: str) -> bytes:
    """Damage a file as :func:`damaged` does, or a part of it inside an intact container."""
    if draw(st.integers(0, 2)) == 0:
        return draw(damaged(data))
    if suffix == ".png":
        return draw(_png(data))
    if suffix == ".npz":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        name = draw(st.sampled_from(sorted(members)))
        inside = draw(damaged_inside(members.pop(name), ".npy"))
        members[draw(st.sampled_from((name, name, name, "../x.npy", "/x.npy", "x")))] = inside
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, content in members.items():
                archive.writestr(member, content)
        return file.getvalue()
    if suffix in (".npy", ".safetensors"):
        size, at = ("<H", 10) if suffix == ".npy" else ("<Q", 8)
        start = at - struct.calcsize(size)
        end = at + struct.unpack(size, data[start:at])[0]
        inside = damaged(data[at:end]) if suffix == ".npy" else _json(data[at:end])
        header = draw(inside)[:60_000]
        return data[:start] + struct.pack(size, len(header)) + header + data[end:]
    if suffix in (".json", ".sfm"):
        return draw(_json(data))
    return draw(damaged(data))


@st.composite
def _png(draw, data: bytes) -> bytes:
    """Damage the data of a chunk and fix its checksum; compressed data are recompressed."""
    at, pieces = 8, [data[:8]]
    chunks = []
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    chosen = draw(st.integers(0, len(chunks) - 1))
    for index, (kind, body) in enumerate(chunks):
        if index == chosen and kind == b"IDAT" and draw(st.booleans()):
            body = zlib.compress(draw(damaged(zlib.decompress(body))))
        elif index == chosen:
            body = draw(damaged(body))
        pieces.append(struct.pack(">I", len(body)) + kind + body)
        pieces.append(struct.pack(">I", zlib.crc32(kind + body)))
    return b"".join(pieces)


@st.composite
def _json(draw, data: bytes) -> bytes:
    """Replace values in the tree by values of other types, also in texts that contain trees."""
    tree = json.loads(data)
    places: list[tuple[object, object]] = []
    stack = [tree]
    while stack:
        node = stack.pop()
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                stack.append(node[key])
    node, key = draw(st.sampled_from(places))
    inner = node[key]
    if draw(st.booleans()) and isinstance(node, dict):
        del node[key]
    elif isinstance(inner, str) and inner.startswith("{"):
        node[key] = draw(_json(inner.encode())).decode()
    else:
        node[key] = draw(VALUES)
    return json.dumps(tree).encode()


_opened: list[str] = []


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        _opened.append(os.fsdecode(arguments[0]))
    elif event == "pickle.find_class":
        _opened.append(f"/pickle of {arguments}")


@contextmanager
def limited() -> Iterator[None]:
    """Limit a block to two more gigabytes and twenty seconds."""
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    former = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (held + LIMIT_BYTES, former[1]))
    faulthandler.dump_traceback_later(LIMIT_SECONDS, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, former)


def unsound(result: object, where: str = "result") -> Iterator[str]:
    """Yield the errors of a result."""
    if isinstance(result, SparseModel):
        rotation = result.cam_from_world[:, :3, :3]
        off = rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype)
        rigid = bool((off.abs() < 1e-3).all())
        values = (result.cam_from_world, result.points_world, result.observation_pixels)
        lenses = [torch.tensor((*one.params, one.width, one.height)) for one in result.lenses]
        finite = all(bool(value.isfinite().all()) for value in (*values, *lenses))
        positive = all(min(one.params[0], one.width, one.height) > 0 for one in result.lenses)
        if not (rigid and finite and positive):
            yield f"{where}: poses or lenses"
        for index, count in (
            (result.observation_point, len(result.points_world)),
            (result.observation_view, result.num_views),
        ):
            if not bool(((index >= 0) & (index < count)).all()):
                yield f"{where}: indices out of range"
    elif isinstance(result, Record):
        yield from (f"{where}: {fault}" for fault in result.faults())
        for name in type(result).__dataclass_fields__:
            yield from unsound(getattr(result, name), f"{where}.{name}")
    elif isinstance(result, tuple | list):
        for index, one in enumerate(result):
            yield from unsound(one, f"{where}[{index}]")
    elif isinstance(result, torch.Tensor) and result.is_floating_point():
        # Depth is infinite off the object, and focal lengths are NaN where unknown.
        known = where.rpartition(".")[2] not in ("depth", "focals_px")
        if known and bool(result.isnan().any()):
            yield f"{where} has NaN"


def tried(seed, copy: Path) -> None:
    """Read a damaged copy of a folder."""
    _opened.clear()
    try:
        with limited(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = seed.read(copy)
    except PimperError as error:
        text = str(error).replace(str(copy), "")
        assert not FOREIGN.search(text), text
    else:
        assert [*unsound(result)] == []
    allowed = (str(copy.resolve()), *SYSTEM, PACKAGE)
    outside = [path for path in _opened if Path(path).is_absolute()]
    assert [path for path in outside if not os.path.realpath(path).startswith(allowed)] == []


@pytest.mark.parametrize("count", [150, pytest.param(5000, marks=pytest.mark.slow)])
def test_damaged_files_give_clean_errors_or_valid_results(count, tmp_path):
    sys.addaudithook(_watch)
    seeds = make_seeds(tmp_path / "seeds")
    copy = tmp_path / "case" / "in"
    (tmp_path / "outside.png").write_bytes(b"")

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def check(data):
        seed = data.draw(st.sampled_from(seeds))
        file = data.draw(st.sampled_from(seed.files))
        content = data.draw(damaged_inside((seed.folder / file).read_bytes(), Path(file).suffix))
        note(f"{seed.name}: {file}")
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(seed.folder, copy)
        (copy / file).write_bytes(content)
        tried(seed, copy)

    check()
