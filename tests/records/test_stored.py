"""Records in files: round trips are exact bit for bit, and untrusted files are refused."""

import dataclasses
import json
import math
import typing
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, safe_open, save_file
from torch import Tensor

import pimper_torch as pt
from pimper_torch import records
from pimper_torch.chains.chain import Step
from pimper_torch.records import Record, stored
from pimper_torch.records.stored import load_record, save_record
from pimper_torch.runtime.errors import InputError, OutputError
from pimper_torch.runtime.events import Event

# Lengths of axes shared by fields; all different, so that exchanged axes are detected.
AXES = {"patch": 2, "view": 3, "height": 4, "width": 5, "channel": 1, "vertex": 6, "face": 7}
BITS = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Odds(Record):
    """All types of fields in one record."""

    many: tuple[Tensor | None, ...]
    pair: tuple[int, float]
    name: str | None
    numbers: tuple[float, ...]
    figures: dict[str, int | float]
    flag: bool | None = None


def every_record():
    found = vars(records).values()
    return [one for one in found if isinstance(one, type) and issubclass(one, Record)]


def example(hint, generator, full=True):
    """Make a value for an annotation: random tensors, records with all fields."""
    choices = [one for one in typing.get_args(hint) if one is not type(None)]
    if typing.get_origin(hint) in (tuple, dict):
        if typing.get_origin(hint) is dict:
            texts = {"one": "é\ud800", "other": ""}
            numbers = {"whole": 3, "half": 0.5, "open": math.inf}
            return texts if typing.get_args(hint)[1] is str else numbers
        whole = typing.get_args(hint)
        items = choices[:1] * 2 if whole[-1] is Ellipsis else whole
        return tuple(example(item, generator, full) for item in items)
    if typing.get_origin(hint) is typing.Literal:
        return choices[-1]
    if choices:
        empty = not full and type(None) in typing.get_args(hint)
        return None if empty else example(choices[-1 if full else 0], generator, full)
    if isinstance(hint, type) and issubclass(hint, Record | Event):
        hints = typing.get_type_hints(hint)
        fields = [
            one for one in dataclasses.fields(hint) if full or one.default is dataclasses.MISSING
        ]
        return hint(**{one.name: example(hints[one.name], generator, full) for one in fields})
    if hasattr(hint, "dim_str"):
        shape = [int(one) if one.isdigit() else AXES.get(one, 8) for one in hint.dim_str.split()]
        values = torch.randn(shape, generator=generator, dtype=torch.float64)
        values[values > 1] = torch.nan
        kinds = {
            "Float": torch.float64,
            "Bool": torch.bool,
            "Int": torch.int64,
            "UInt8": torch.uint8,
        }
        return values.nan_to_num().to(kinds[hint.__name__.partition("[")[0]])
    return {str: "é\ud800", int: -(2**60), float: 0.1 + 0.2, bool: True}[hint]


def assert_same(found, wanted):
    """Compare types and bits recursively."""
    assert type(found) is type(wanted)
    if isinstance(wanted, Record):
        for field in dataclasses.fields(wanted):
            assert_same(getattr(found, field.name), getattr(wanted, field.name))
    elif isinstance(wanted, tuple | list):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other)
    elif isinstance(wanted, dict):
        assert list(found) == list(wanted)
        assert_same(list(found.values()), list(wanted.values()))
    elif isinstance(wanted, Tensor):
        assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape)
        bits = BITS[wanted.element_size()] if wanted.dtype != torch.complex64 else torch.int32
        assert torch.equal(*(one.contiguous().reshape(-1).view(bits) for one in (found, wanted)))
    elif isinstance(wanted, float):
        assert wanted.hex() == found.hex()
    else:
        assert found == wanted


@pytest.fixture
def odds():
    whole = torch.arange(12.0).reshape(3, 4)
    return Odds(
        many=(whole, None, whole, whole.T, whole[1:], torch.zeros(0, 3), torch.tensor(7)),
        pair=(1, 2.0),
        name="../éa b/c.png",
        numbers=(-0.0, math.nan, -math.inf, 1e-320, 3.0),
        figures={"samples": 3, "fraction": math.nan},
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "odds.safetensors"


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("cls", [*every_record(), Step])
def test_every_record_survives_a_round_trip_bit_for_bit(cls, full, generator, tmp_path):
    record = example(cls, generator, full)
    pt.save_record(record, str(tmp_path / "new" / "one.safetensors"))
    assert_same(pt.load_record(cls, tmp_path / "new" / "one.safetensors"), record)


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("cls", [*every_record(), Step])
def test_every_record_is_data_for_torch(cls, full, generator, tmp_path):
    """`weights_only` refuses all classes that are not declared to contain no code."""
    record = example(cls, generator, full)
    torch.save({"record": record}, tmp_path / "one.pt")
    assert_same(torch.load(tmp_path / "one.pt", weights_only=True)["record"], record)


def test_every_type_of_field_survives_a_round_trip_bit_for_bit(odds, path):
    kinds = [torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64]
    kinds += [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.complex64]
    values = torch.tensor([0.0, 1.0, 2.0])
    odds = odds.replace(many=(*odds.many, *(values.to(kind) for kind in kinds)))
    odds = odds.replace(many=(*odds.many, torch.tensor([math.nan, -0.0, math.inf]).bfloat16()))
    save_record(odds, path)
    assert_same(load_record(Odds, path), odds)


def test_a_shared_tensor_is_stored_once_and_stays_shared(odds, path):
    save_record(odds, path)
    assert set(load_file(path)) == {f"many[{index}]" for index in (0, 3, 4, 5, 6)}
    found = load_record(Odds, path)
    assert found.many[0] is found.many[2]


def test_overlapping_tensors_survive_a_round_trip_bit_for_bit(odds, path, generator):
    memory = torch.rand(300, generator=generator)
    firsts = torch.randint(0, 280, (60,), generator=generator).tolist()
    lengths = torch.randint(0, 20, (60,), generator=generator).tolist()
    parts = tuple(memory[a : a + n] for a, n in zip(firsts, lengths, strict=True))
    record = odds.replace(many=(*parts, memory, memory[7:7], memory.reshape(30, 10).T))
    save_record(record, path)
    for found, wanted in zip(load_record(Odds, path).many, record.many, strict=True):
        assert_same(found, wanted)


def test_a_file_is_mapped_and_writes_to_tensors_do_not_change_it(odds, path):
    save_record(odds, path)
    before = path.read_bytes()
    found = load_record(Odds, path)
    assert str(path) in Path("/proc/self/maps").read_text()
    found.many[0][:] = 5
    assert path.read_bytes() == before
    assert_same(load_record(Odds, path), odds)


def test_a_record_with_gradients_is_saved_without_its_graph(odds, path):
    leaf = torch.ones(2, requires_grad=True)
    save_record(odds.replace(many=(2 * leaf,)), path)
    found = load_record(Odds, path).many[0]
    assert found.tolist() == [2, 2]
    assert not found.requires_grad


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda: 1, "A file cannot contain a function; needed: records, "),
        (Path("a"), "cannot contain a PosixPath"),
        ([1], "Odds.many.0 is .1.; needed"),
        ({1: 2}, "Odds.many.0 is .*; needed"),
        (records.PatchStatus.FAILED, "Odds.many.0 is 5; needed"),
        (torch.zeros(2, dtype=torch.complex128), "cannot contain a torch.complex128"),
        (torch.eye(2).to_sparse(), "cannot contain a torch.float32 torch.sparse_coo Tensor"),
        (torch.zeros(2, device="meta"), "needed: .* dense tensors with values"),
    ],
)
def test_values_that_cannot_be_stored_are_refused(odds, path, value, message):
    with pytest.raises(InputError, match=message):
        save_record(odds.replace(many=(value,)), path)
    assert not path.exists()


def test_a_failed_save_leaves_only_the_former_file(odds, path, monkeypatch):
    save_record(odds, path)
    before = path.read_bytes()

    def full_disk(tensors, trial, metadata):
        Path(trial).write_bytes(b"half")
        raise OSError("No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(stored, "save_file", full_disk)
        with pytest.raises(OutputError, match="No space left on device"):
            save_record(odds.replace(name=None), path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
    mapped = load_record(Odds, path)
    save_record(odds.replace(many=()), path)  # readers of the former file keep it
    assert_same(mapped, odds)
    assert load_record(Odds, path).many == ()
    with pytest.raises(OutputError, match=r"odds.safetensors.one: writing failed"):
        save_record(odds, path / "one")


def test_incomplete_or_foreign_files_are_refused(odds, path, tmp_path):
    with pytest.raises(InputError, match="is not a file; needed: a file that `save_record` wrote"):
        load_record(Odds, tmp_path)
    save_record(odds, path)
    whole = path.read_bytes()
    claimed = (2**60).to_bytes(8, "little") + whole[8:]  # a header larger than memory
    shape = whole.replace(b'"shape":[3,4]', b'"shape":[9,4]')
    for damaged in (b"", whole[:4], whole[:200], whole[:-1], whole + b"x", claimed, shape):
        assert damaged != whole
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="seems truncated or damaged"):
            load_record(Odds, path)
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(InputError, match=r"contains only tensors; needed: 'pimper_torch record 2'"):
        load_record(Odds, path)
    save_file({"a": torch.zeros(2)}, path, {"pimper_torch": '{"format": 1}'})  # as 0.10 wrote it
    with pytest.raises(
        InputError, match=r"contains pimper_torch; needed: 'pimper_torch record 2', "
    ):
        load_record(Odds, path)


def test_a_record_of_a_different_class_is_refused(odds, path):
    save_record(odds, path)
    with pytest.raises(InputError, match=r'Mesh is {"record": "Odds", .*; needed: Mesh\.'):
        load_record(pt.Mesh, path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spare": 1}, "Odds has the fields many, .*, spare; needed: many, .*flag"),
        ({"pair": [1, 1.0, 1]}, "Odds.pair is .1, 1.0, 1.; needed: tuple"),
        ({"pair": [True, 1.0]}, "Odds.pair.0 is true; needed: int"),
        ({"pair": [1, "nine"]}, 'Odds.pair.1 is "nine"; needed: float'),
        ({"many": [{"tensor": "/etc/passwd"}]}, "Odds.many.0 is .*passwd.*; needed: .*Tensor"),
        ({"many": [{"tensor": []}]}, "Odds.many.0 is"),
        ({"many": [{"record": "Mesh", "fields": {}}]}, "Odds.many.0 is .*Mesh.*; needed: .*Tensor"),
        ({"name": {"record": []}}, "Odds.name is .*; needed: str . None"),
        ({"figures": {"a": None}}, "Odds.figures.a is null; needed: int . float"),
        ("{", "seems truncated or damaged"),
        ("[" * 10**5 + "]" * 10**5, "seems truncated or damaged"),
        ("9" * 5000, "seems truncated or damaged"),
        ("1" + " " * 2**25, "at most 33554432 bytes"),
    ],
    ids=lambda one: str(one)[:40],
)
def test_an_untrusted_structure_is_refused_at_its_error(odds, path, changes, message):
    save_record(odds, path)

    def forged(structure):
        if isinstance(changes, str):
            return changes
        return json.dumps(structure | {"fields": structure["fields"] | changes})

    forge(path, forged)
    with pytest.raises(InputError, match=message):
        load_record(Odds, path)


@pytest.mark.usefixtures("shapes_unchecked")
def test_a_tensor_of_the_wrong_shape_is_refused_by_file_and_field(path, generator):
    save_record(example(pt.Cameras, generator), path)
    forge(path, json.dumps, cam_from_world=torch.zeros(3, 3, 4))
    message = r"odds.safetensors: Cameras.cam_from_world is float32\[3, 3, 4\]; needed: "
    with pytest.raises(InputError, match=message):
        load_record(pt.Cameras, path)


def forge(path, change, **others):
    """Rewrite a file with a changed structure or other tensors."""
    with safe_open(path, framework="pt") as file:
        structure = json.loads(file.metadata()[stored._KEY])
    tensors = {name: one.clone() for name, one in load_file(path).items()}
    save_file(tensors | others, path, {stored._KEY: change(structure)})
