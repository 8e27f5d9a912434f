"""A plugin's settings: one pydantic model for validation, `measure plugins show` and docs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from measure.errors import ConfigError


class Settings(BaseModel):
    """Base of every plugin's `Config`: frozen; a misspelt field, NaN or infinity is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def setting(default: Any, description: str, *, unit: str = "", **limits: Any) -> Any:
    """A field of a `Config`.

    Args:
        description: one sentence, shown by `measure plugins show` and in the docs.
        unit: px, mm, m, deg, rad, s, ms, Hz, %, votes, px² or mm²; empty for a bare number or word.
        **limits: pydantic's `ge`, `gt`, `le`, `lt`, `multiple_of`.
    """
    return Field(default, description=description, json_schema_extra={"unit": unit}, **limits)


@dataclass(frozen=True)
class Setting:
    """A setting as it is printed."""

    name: str  # of the field
    type: str  # such as `float`
    default: str  # as text, or "required"
    unit: str  # as given to `setting`; empty for a bare number or word
    description: str  # one sentence


def describe_settings(config: type[Settings]) -> list[Setting]:
    """The settings of a `Config` class, in the order of its fields."""
    out = []
    for name, info in config.model_fields.items():
        extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        annotation = info.annotation
        kind = annotation.__name__ if isinstance(annotation, type) else str(annotation)
        out.append(
            Setting(
                name=name,
                type=kind.replace("typing.", ""),
                default="required"
                if info.is_required()
                else repr(info.get_default(call_default_factory=True)),
                unit=str(extra.get("unit", "")),
                description=info.description or "",
            )
        )
    return out


C = TypeVar("C", bound=BaseModel)


def read_settings(config: type[C], values: Mapping[str, Any], owner: str) -> C:
    """Validate `values` as a `Config`.

    ConfigError: an unknown name (the message lists the known ones) or a value that does not fit.

    Args:
        values: names and values; numbers and booleans may come as text from a command line.
        owner: whose settings they are ("detector 'hough'"), for the message.
    """
    try:
        return config.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(f"{owner}: {explain_validation(error, config)}") from None


def explain_validation(error: ValidationError, config: type[BaseModel]) -> str:
    """The first problem of a pydantic error in one line."""
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden" and len(first["loc"]) == 1:
        return (
            f"unknown setting '{where}'; it has {', '.join(config.model_fields) or 'no settings'}"
        )
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    what = first["msg"][0].lower() + first["msg"][1:]
    given = "" if first["type"] == "missing" else f", got {first['input']!r}"
    return f"'{where}': {what}{given}{more}"
