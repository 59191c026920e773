"""Settings: one definition for YAML and the command line, strict in both."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from magic_core.config import from_mapping, load_yaml, save_yaml, to_mapping
from magic_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Inner:
    rate: float = 0.5
    steps: tuple[int, ...] = (1, 2)
    solver: Literal["fast", "slow"] = "fast"


@dataclass(frozen=True, slots=True)
class Outer:
    path: Path = Path("somewhere")
    limit: int | None = None
    inner: Inner = field(default_factory=Inner)


def test_a_saved_config_reads_back_equal(tmp_path):
    config = Outer(path=Path("/data"), limit=7, inner=Inner(rate=2.0, steps=(3,), solver="slow"))
    save_yaml(config, tmp_path / "config.yaml")
    assert load_yaml(Outer, tmp_path / "config.yaml") == config


def test_missing_settings_keep_their_defaults():
    assert from_mapping(Outer, {"limit": 3}) == Outer(limit=3)


def test_a_whole_number_is_a_number():
    assert from_mapping(Outer, {"inner": {"rate": 2}}).inner.rate == 2.0


@pytest.mark.parametrize("written", ["1e-7", "1E-7", "1e-07", "+1e-7", "1.0e-7"])
def test_a_number_may_have_an_exponent_without_a_point(written, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(f"inner: {{rate: {written}}}")
    assert load_yaml(Outer, path).inner.rate == 1e-7


@pytest.mark.parametrize(
    ("mapping", "named"),
    [
        ({"limt": 3}, "limt"),
        ({"inner": {"rat": 1.0}}, "rat"),
        ({"inner": {"rate": "quick"}}, "quick"),
        ({"inner": {"rate": True}}, "True"),
        ({"inner": {"solver": "medium"}}, "medium"),
        ({"inner": {"steps": [1.5]}}, "1.5"),
        ("just text", "Outer"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(mapping, named):
    with pytest.raises(ConfigError, match=named):
        from_mapping(Outer, mapping)


def test_broken_yaml_names_the_file(tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text("a: [1,")
    with pytest.raises(ConfigError, match=r"broken\.yaml"):
        load_yaml(Outer, path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.yaml"):
        load_yaml(Outer, tmp_path / "absent.yaml")


def test_plain_values_only():
    assert to_mapping(Outer()) == {
        "path": "somewhere",
        "limit": None,
        "inner": {"rate": 0.5, "steps": [1, 2], "solver": "fast"},
    }
