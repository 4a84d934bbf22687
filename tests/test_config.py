from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import yaml

from pimper_torch.paper.paper_config import PublishedConfig
from pimper_torch.presets.load_config import load_config
from pimper_torch.runtime import config as config_module
from pimper_torch.runtime.config import (
    build,
    find_config,
    overlay,
    presets,
    read_mapping,
    require,
    to_mapping,
    to_yaml,
)
from pimper_torch.runtime.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    steps: int = 9
    tolerance: float = 1e-6
    robust: bool = True
    solver: Literal["balm", "descent"] = "balm"

    def __post_init__(self):
        require(self.steps > 0, "steps", self.steps, "at least one")


@dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    name: str = "x"
    window: tuple[int, int] = (5, 5)
    scales: tuple[float, ...] = (0.25, 0.5, 1.0)
    cache: Path | None = None
    limit: int | None = None
    inner: Inner = field(default_factory=Inner)


CHANGED = Outer(
    name="y",
    window=(3, 7),
    scales=(1.0,),
    cache=Path("a/b"),
    limit=4,
    inner=Inner(steps=2, tolerance=float("inf"), robust=False, solver="descent"),
)


@pytest.mark.parametrize("config", [Outer(), CHANGED])
def test_a_config_survives_a_round_trip_through_yaml(config):
    assert build(Outer, yaml.safe_load(to_yaml(config)), "round trip") == config
    assert build(Outer, to_mapping(config), "round trip") == config


def test_only_named_settings_change_and_integers_become_floats():
    built = build(Outer, {"inner": {"steps": 3}, "limit": None}, "w")
    assert built == Outer(inner=Inner(steps=3))
    assert build(Outer, {"inner": None}, "an empty section in YAML") == Outer()
    built = build(Inner, {"tolerance": 2}, "w")
    assert isinstance(built.tolerance, float)
    assert build(Inner, yaml.safe_load("tolerance: 1e-3"), "w").tolerance == 1e-3


@pytest.mark.parametrize(
    ("mapping", "field", "needed"),
    [
        ({"inner": {"steps": 2.0}}, "inner.steps", "an integer"),
        ({"inner": {"steps": True}}, "inner.steps", "an integer"),
        ({"inner": {"tolerance": False}}, "inner.tolerance", "a number"),
        ({"inner": {"tolerance": "small"}}, "inner.tolerance", "a number"),
        ({"inner": {"robust": 1}}, "inner.robust", "true or false"),
        ({"inner": {"robust": "yes"}}, "inner.robust", "true or false"),
        ({"inner": {"solver": "newton"}}, "inner.solver", "'balm', 'descent'"),
        ({"inner": 3}, "inner", "steps, tolerance, robust, solver"),
        ({"name": 3}, "name", "a text"),
        ({"window": [1, 2, 3]}, "window", "a list of an integer, an integer"),
        ({"window": 5}, "window", "a list"),
        ({"scales": [1.0, "a"]}, "scales[1]", "a number"),
        ({"scales": None}, "scales", "a list"),
        ({"limit": "many"}, "limit", "an integer"),
        ({"cache": 3}, "cache", "a path"),
    ],
)
def test_a_wrong_type_is_refused_with_its_field_and_the_needed_type(mapping, field, needed):
    with pytest.raises(ConfigError) as refusal:
        build(Outer, mapping, "mine.yaml")
    message = str(refusal.value)
    assert message.startswith(f"mine.yaml: {field} is ")
    assert needed in message.partition("needed:")[2]


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"inner": {"step": 3}}, "section `inner` .*`step`.*mean `steps`.*: steps, tol.*, solver"),
        ({"solver": "balm"}, r"top level has no setting `solver`.*`inner\.solver`"),
        ({"inner": {"steps": 0}}, "inner: steps is 0; needed: at least one"),
    ],
)
def test_unknown_keys_and_invalid_values_are_refused_with_file_and_section(mapping, message):
    with pytest.raises(ConfigError, match=rf"mine\.yaml: .*{message}"):
        build(Outer, mapping, "mine.yaml")


def test_overlay_merges_sections_and_leaves_its_inputs_unchanged():
    base = {"a": {"x": 1, "y": [1, 2]}, "b": 1}
    other = {"a": {"y": [3]}, "c": None}
    assert overlay(base, other) == {"a": {"x": 1, "y": [3]}, "b": 1, "c": None}
    assert base == {"a": {"x": 1, "y": [1, 2]}, "b": 1}
    assert overlay(base, {"a": None, "b": None}) == {"a": {"x": 1, "y": [1, 2]}, "b": None}


def test_a_misspelt_preset_suggests_the_nearest():
    with pytest.raises(ConfigError, match=r"'papre'.*`paper`.*default, fast, paper, training"):
        find_config("papre")


def test_a_config_file_is_read_unchanged_and_a_missing_one_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("# only a remark\n")
    assert find_config(str(path)) == find_config(path) == path
    assert read_mapping(path) == {}
    with pytest.raises(ConfigError, match=r"other\.yaml: there is no such file"):
        find_config(tmp_path / "other.yaml")


def test_installed_presets_take_precedence_over_a_checkout(tmp_path, monkeypatch):
    package = tmp_path / "package"
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "a.yaml").write_text("")
    package.mkdir()
    monkeypatch.setattr(config_module.resources, "files", lambda name: package)
    assert presets() == ("a",)
    (package / "configs").mkdir()
    (package / "configs" / "b.yaml").write_text("")
    assert presets() == ("b",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"a: 1\nb: 2\na: 3\n", "`a` occurs twice"),
        (b"a: {b: 1, b: 2}\n", "`b` occurs twice"),
        (b"a: [1\n", "not valid YAML"),
        (b"- a\n- b\n", "contains a list"),
        (b"!!python/object/apply:os.getcwd []\n", "not valid YAML"),
        (b"\xff\xfe\x00a", "cannot be read"),
        (b"a: &a [x, x]\nb: *a\n", "aliases .* are not supported"),
        (b"a: " + b"[" * 100_000, "nested too deeply"),
        (b"a: " + b"9" * 5000, "contains an invalid value"),
        (b"? [a, b]\n: 1\n", "found unhashable key"),
        (b"a: 2001-99-99\n", "contains an invalid value"),
        (b"# " + b"x" * 1_000_000, "1000002 bytes; needed: a YAML file with settings"),
    ],
)
def test_a_file_without_settings_is_refused_by_name(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=message) as refusal:
        read_mapping(path)
    assert str(path) in str(refusal.value)


def leaves(mapping, section=""):
    for key, value in mapping.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{section}{key}.")
        else:
            yield f"{section}{key}", value


ABLATIONS = sorted((Path(__file__).parents[1] / "configs" / "ablation").glob("*.yaml"))


@pytest.mark.parametrize("name", [*presets(), *ABLATIONS], ids=lambda name: Path(name).stem)
def test_a_preset_contains_only_non_default_settings(name):
    mapping = read_mapping(find_config(name))
    config = load_config(name)
    assert build(type(config), mapping, str(name)) == config
    defaults = dict(leaves(to_mapping(type(config)())))
    same = [path for path, value in leaves(mapping) if defaults[path] == value]
    assert same == (["chain"] if "chain" in mapping else [])


def test_settings_name_their_chain():
    assert load_config("default").chain == "coarse-to-fine"
    assert load_config("paper").chain == "published"
    assert load_config("default", {"chain": "published"}) == PublishedConfig()
    with pytest.raises(ConfigError, match="chain is 'other'; needed: coarse-to-fine or published"):
        load_config("default", {"chain": "other"})
    with pytest.raises(ConfigError, match="no setting `sweep`"):
        load_config("paper", {"sweep": {"steps": 9}})


def test_changes_that_are_no_settings_are_refused():
    with pytest.raises(ConfigError, match="changes is 'text'; needed: settings nested by stage"):
        load_config("default", "text")


def test_changes_override_a_preset():
    changed = load_config("fast", {"reconstruct": {"seed": 12}})
    assert changed.reconstruct.seed == 12
    assert changed.decompose == load_config("fast").decompose


def test_huge_numbers_and_long_texts_are_refused_with_a_short_message(tmp_path):
    for value in ("1" + "0" * 400, "x" * 9000):
        (tmp_path / "a.yaml").write_text(f"tolerance: {value}\n")
        with pytest.raises(ConfigError, match="needed: a number") as message:
            build(Inner, read_mapping(tmp_path / "a.yaml"), "a.yaml")
        assert len(str(message.value)) < 400
