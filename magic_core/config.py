"""Settings as dataclasses: to YAML, from YAML, validated once.

A config is a frozen dataclass of plain values and other such dataclasses. The command line is made
from the same definition (tyro), so a setting has one name everywhere: `tracking.solver` in YAML is
`--tracking.solver` on the command line.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any, TypeVar

import cattrs
import cattrs.gen
import yaml

from magic_core.errors import ConfigError, FieldViolation

T = TypeVar("T")


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True)
    converter.register_unstructure_hook(Path, str)
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    converter.register_structure_hook(float, _strict_float)
    converter.register_structure_hook(int, _strict_int)
    converter.register_structure_hook(bool, _strict_bool)
    return converter


_EXPONENT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")
"""1e-7, a number for everyone who writes YAML, is text to PyYAML, which follows YAML 1.1."""


def _strict_float(value: Any, _: type) -> float:
    if isinstance(value, str) and _EXPONENT.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{value!r} is not a number")
    return float(value)


def _strict_int(value: Any, _: type) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r} is not a whole number")
    return value


def _strict_bool(value: Any, _: type) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{value!r} is neither true nor false")
    return value


def to_mapping(config: Any) -> dict[str, Any]:
    """A config dataclass as nested dicts of plain values (paths as strings, tuples as lists)."""
    return _plain(_converter().unstructure(config))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value


def from_mapping(cls: type[T], mapping: Any) -> T:
    """A config of class `cls` from nested dicts; missing settings keep their defaults.

    Raises ConfigError that names every unknown setting and every value of a wrong type.
    """
    if not isinstance(mapping, dict):
        raise ConfigError(f"{cls.__name__}: {mapping!r} is not a mapping of settings to values")
    try:
        return _converter().structure(mapping, cls)
    except cattrs.BaseValidationError as error:
        texts = [
            text.replace("$.", "")
            for text in cattrs.transform_error(error, format_exception=_describe)
        ]
        found = tuple(FieldViolation(text.rsplit("@", 1)[-1].strip(), text) for text in texts)
        message = f"{cls.__name__}: " + "; ".join(texts)
        raise ConfigError(message, violations=found) from error


def _describe(error: BaseException, expected: type | None) -> str:
    """cattrs' own words for unknown settings; the value itself for a wrong one."""
    if isinstance(error, cattrs.ForbiddenExtraKeysError):
        return f"unknown setting {', '.join(sorted(error.extra_fields))}"
    if isinstance(error, AttributeError):
        return "expected a mapping of settings to values"
    return str(error) or f"expected {expected}"


def load_yaml(cls: type[T], path: Path) -> T:
    """A config of class `cls` from a YAML file. Raises ConfigError naming the file."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); give a YAML file") from error
    try:
        mapping = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {error}") from error
    try:
        return from_mapping(cls, mapping if mapping is not None else {})
    except ConfigError as error:
        raise ConfigError(f"{path}: {error.message}", violations=error.violations) from error


def save_yaml(config: Any, path: Path) -> None:
    """Write a config dataclass as YAML that `load_yaml` accepts back."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(to_mapping(config), sort_keys=False), encoding="utf-8")


def field_names(cls: type) -> tuple[str, ...]:
    """Names of the settings of a config dataclass."""
    return tuple(field.name for field in dataclasses.fields(cls))
