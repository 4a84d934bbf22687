"""Damage and malice: bytes of a valid file to those of another, by a seeded generator."""

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random

import numpy as np

_INTEGERS = (0, 1, -1, 2**7, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63)
_DOUBLES = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e308, 1e-308, 1e20)
_WORDS = ("0", "-1", "nan", "inf", "1e308", "2147483648", "9223372036854775808", "1e-320", "", "x")
_ESCAPES = ("../../outside.png", "/etc/passwd", "..\\outside.png", "a\\u0000b", "C:\\x.png", "~")
_TEXT = (".txt", ".json", ".yaml", ".csv", ".xml", ".sfm", ".obj")

Mutation = Callable[[bytes, Random], bytes]


def mutated(data: bytes, suffix: str, random: Random) -> tuple[str, bytes]:
    """Give the name of a mutation and what it makes of a file."""
    choices: list[Mutation] = [_flipped, _cut, _spliced, _filled, _integers, _doubles, _grown]
    text = suffix in _TEXT or (suffix in (".ply", ".stl", ".off") and b"\0" not in data)
    if text:
        choices += [_tokens, _tokens, _tokens, _lines, _nested, _escaped]
    if suffix in (".ply", ".glb"):
        choices += [_tokens]
    if suffix == ".json" or suffix == ".sfm":
        choices += [_json_values, _json_values, _json_values]
    if suffix == ".yaml":
        choices += [_yaml_bomb, _nested]
    if suffix == ".png":
        choices += [_png_header, _png_header, _png_bomb, _png_chunks, _png_chunks]
    if suffix in (".tif", ".jpg", ".bmp", ".ppm", ".mat", ".stl", ".glb", ".bin"):
        choices += [_integers, _head, _head]
    if suffix == ".npz":
        choices += [_npz_members, _npz_members, _npz_members, _npz_bomb, _npz_names]
    if suffix == ".npy":
        choices += [_npy_header, _npy_header]
    if suffix == ".safetensors":
        choices += [_safetensors, _safetensors]
    mutation = random.choice(choices)
    return mutation.__name__.strip("_"), mutation(data, random)


def _flipped(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 5, 20)) if data else 0):
        changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _spliced(data: bytes, random: Random) -> bytes:
    first, last = sorted(random.randrange(len(data) + 1) for _ in range(2))
    at = random.randrange(len(data) + 1)
    return data[:at] + data[first:last] + data[at + random.choice((0, last - first)) :]


def _filled(data: bytes, random: Random) -> bytes:
    first, last = sorted(random.randrange(len(data) + 1) for _ in range(2))
    if random.random() < 0.1:
        first, last = 0, len(data)
    return data[:first] + random.choice((b"\0", b"\xff")) * (last - first) + data[last:]


def _put(data: bytes, random: Random, piece: bytes, within: int) -> bytes:
    if len(data) < len(piece):
        return data
    at = random.randrange(min(within, len(data) - len(piece)) + 1)
    return data[:at] + piece + data[at + len(piece) :]


def _integer(random: Random) -> bytes:
    length = random.choice((1, 2, 4, 4, 8))
    value = random.choice(_INTEGERS) % 256**length
    return value.to_bytes(length, random.choice(("little", "little", "big")))


def _integers(data: bytes, random: Random) -> bytes:
    for _ in range(random.choice((1, 1, 2, 4))):
        data = _put(data, random, _integer(random), len(data))
    return data


def _head(data: bytes, random: Random) -> bytes:
    for _ in range(random.choice((1, 1, 2))):
        data = _put(data, random, _integer(random), 96)
    return data


def _doubles(data: bytes, random: Random) -> bytes:
    for _ in range(random.choice((1, 3, 9))):
        data = _put(data, random, struct.pack("<d", random.choice(_DOUBLES)), len(data))
    return data


def _grown(data: bytes, random: Random) -> bytes:
    return data + random.randbytes(random.choice((1, 7, 64, 4096)))


def _tokens(data: bytes, random: Random) -> bytes:
    pieces = list(re.finditer(rb"[-+.\w]+", data))
    for _ in range(random.choice((1, 1, 2, 5))):
        if pieces:
            piece = random.choice(pieces)
            word = random.choice(_WORDS).encode()
            data = data[: piece.start()] + word + data[piece.end() :]
            pieces = list(re.finditer(rb"[-+.\w]+", data))
    return data


def _lines(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    what = random.randrange(4)
    if what == 0:
        del lines[at]
    elif what == 1:
        lines.insert(at, lines[other])
    elif what == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = lines[at] * random.choice((3, 300))
    return b"\n".join(lines)


def _nested(data: bytes, random: Random) -> bytes:
    depth = random.choice((50, 2000, 100_000))
    pair = random.choice((b"[]", b"{}", b"()"))
    nest = pair[:1] * depth + (pair[1:] * depth if random.random() < 0.7 else b"")
    if random.random() < 0.3:
        nest = b'{"a":' * depth + b"1" + b"}" * depth
    numbers = list(re.finditer(rb"[-+.\d]+", data))
    if not numbers:
        return nest
    at = random.choice(numbers)
    return data[: at.start()] + nest + data[at.end() :]


def _escaped(data: bytes, random: Random) -> bytes:
    names = list(re.finditer(rb"[\w./\\:-]+\.(?:png|jpg|ply)", data))
    if not names:
        return _tokens(data, random)
    at = random.choice(names)
    return data[: at.start()] + random.choice(_ESCAPES).encode() + data[at.end() :]


def _json_values(data: bytes, random: Random) -> bytes:
    """Put a value of another kind somewhere in the tree."""
    try:
        tree = json.loads(data)
    except ValueError:
        return data
    others: tuple[object, ...] = (
        *(None, True, -1, 0, 2**63, 2**100, 1e308, float("nan"), float("inf"), "", "x", [], {}),
        *([[]], [1, [2]], {"a": 1}, "\ud800", ["x"], [None], "1", 0.5, 10**400, *_ESCAPES),
    )
    for _ in range(random.choice((1, 1, 2))):
        places: list[tuple[object, object]] = []
        stack = [tree]
        while stack:
            node = stack.pop()
            keys = list(node) if isinstance(node, dict) else range(len(node))
            for key in keys:
                places.append((node, key))
                if isinstance(node[key], dict | list):
                    stack.append(node[key])
        if not places:
            break
        node, key = random.choice(places)
        what = random.random()
        if what < 0.15:
            del node[key]  # type: ignore[attr-defined]
        elif what < 0.25 and isinstance(node, list):
            node.append(node[key])  # type: ignore[call-overload]
        else:
            node[key] = random.choice(others)  # type: ignore[index]
    return json.dumps(tree).encode()


def _yaml_bomb(data: bytes, random: Random) -> bytes:
    """Nine levels of nine aliases each: 10^9 entries out of 500 bytes."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [
        f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]"
        for level in range(1, random.choice((6, 9, 12)))
    ]
    if random.random() < 0.3:
        lines = ["a: &a", "  b: *a", *(["warp: *a"] if random.random() < 0.5 else [])]
    elif random.random() < 0.4:
        merges = [
            f"a{level}: &a{level} {{<<: [*a{level - 1}, *a{level - 1}]}}" for level in range(1, 30)
        ]
        lines = ["a0: &a0 {k: v}", *merges]
    return "\n".join([*lines, data.decode()]).encode()


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return chunks


def _png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    pieces = [b"\x89PNG\r\n\x1a\n"]
    for kind, body in chunks:
        pieces.append(struct.pack(">I", len(body)) + kind + body)
        pieces.append(struct.pack(">I", zlib.crc32(kind + body)))
    return b"".join(pieces)


def _png_header(data: bytes, random: Random) -> bytes:
    """Change the header and mend its checksum."""
    chunks = _chunks(data)
    chunks[0] = (chunks[0][0], _put(chunks[0][1], random, _integer(random), 13))
    return _png(chunks)


def _png_chunks(data: bytes, random: Random) -> bytes:
    """Damage what is in a chunk and mend its checksum; compressed data are compressed again."""
    chunks = _chunks(data)
    at = random.randrange(len(chunks))
    kind, body = chunks[at]
    damage = random.choice((_flipped, _cut, _filled, _integers, _grown))
    if kind == b"IDAT" and random.random() < 0.7:
        body = zlib.compress(damage(zlib.decompress(body), random))
    else:
        body = damage(body, random)
    chunks[at] = (kind, body)
    return _png(chunks)


def _png_bomb(data: bytes, random: Random) -> bytes:
    """Write a picture that is all of one level, of 100 to 10^10 pixels in some kilobytes."""
    width, height = random.choice(
        ((10**5, 10**5), (30_000, 30_000), (13_000, 13_000), (12_000, 12_000), (10**6, 90))
    )
    depth, kind = random.choice(((8, 2), (8, 0), (16, 2), (8, 6), (1, 0)))
    channels = {0: 1, 2: 3, 6: 4}[kind]
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    packer = zlib.compressobj(1)
    size = min((1 + width * channels * depth // 8) * height, 2**26)
    body = packer.compress(bytes(size)) + packer.flush()
    return _png([(b"IHDR", header), (b"IDAT", body), (b"IEND", b"")])


def _npy(data: bytes, random: Random) -> bytes:
    """Change an array's header, of the same length, or its values."""
    length = struct.unpack("<H", data[8:10])[0]
    header, values = data[10 : 10 + length].decode("latin-1"), data[10 + length :]
    what = random.randrange(5)
    if what == 0:
        size = random.choice(("2**9", "9999999999", "-1", "0", "2147483648", "99999"))
        header = re.sub(r"\d+", lambda found: size, header, count=random.choice((1, 2, 3)))
    elif what == 1:
        kind = random.choice(("|O", "<f2", "<c16", "<M8[s]", "|S9", "<U99", "<i8", "|b1", "|V8"))
        header = re.sub(r"'descr': '[^']*'", f"'descr': '{kind}'", header)
    elif what == 2:
        shape = random.choice(("()", "(1,)", "(3, 3)", "(0, 17)", "(10**9,)", "(99999, 99999)"))
        header = re.sub(r"'shape': \([^)]*\)", f"'shape': {shape}", header)
    elif what == 3:
        values = _doubles(values, random) if values else values
    else:
        values = _cut(values, random)
    header = header.rstrip(" \n") + "\n"
    return data[:8] + struct.pack("<H", len(header)) + header.encode("latin-1") + values


def _npy_header(data: bytes, random: Random) -> bytes:
    return _npy(data, random) if data[:6] == b"\x93NUMPY" else data


def _members(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zipped(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def _npz_members(data: bytes, random: Random) -> bytes:
    members = _members(data)
    name = random.choice(list(members))
    damage = random.choice((_npy, _npy, _npy, _flipped, _cut, _filled, _doubles))
    members[name] = damage(members[name], random)
    return _zipped(members)


def _npz_names(data: bytes, random: Random) -> bytes:
    members = _members(data)
    name = random.choice(list(members))
    body = members.pop(name)
    if random.random() < 0.5:
        members[random.choice(("../x.npy", "/x.npy", name + "x", "x"))] = body
    return _zipped(members)


def _npz_bomb(data: bytes, random: Random) -> bytes:
    """Let one member be a gigabyte of zeros, or say that it is more."""
    members = _members(data)
    name = random.choice(list(members))
    whole = io.BytesIO()
    np.save(whole, np.zeros(1))
    header = whole.getvalue()[10:-8].decode("latin-1")
    count = random.choice((2**27, 2**27, 2**40))
    shape = random.choice((f"({count},)", f"({count // 3}, 3)", f"(3, 3, {count // 9})"))
    header = header.rstrip(" \n").replace("(1,)", shape) + "\n"
    start = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode("latin-1")
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for other, content in members.items():
            if other != name:
                archive.writestr(other, content)
        with archive.open(name, "w", force_zip64=True) as member:
            member.write(start)
            for _ in range(2**30 // 2**24 if count == 2**27 and random.random() < 0.2 else 1):
                member.write(bytes(2**24))
    return file.getvalue()


def _safetensors(data: bytes, random: Random) -> bytes:
    """Damage the header, and let its length be right."""
    (length,) = struct.unpack("<Q", data[:8])
    header, values = data[8 : 8 + length], data[8 + length :]
    damage = random.choice((_json_values, _json_values, _tokens, _nested, _flipped))
    if random.random() < 0.5:  # the record's own structure, a text in the header
        whole = json.loads(header)
        whole["__metadata__"]["pimper_torch"] = damage(
            whole["__metadata__"]["pimper_torch"].encode(), random
        ).decode("utf-8", "replace")
        header = json.dumps(whole).encode()
    else:
        header = damage(header, random)
    return struct.pack("<Q", len(header)) + header + values
