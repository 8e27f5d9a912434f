"""Records are frozen dataclasses in all but the time that they take to make."""

from __future__ import annotations

import inspect
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace

import pytest

from measure.records import record


@record
class _Sighting:
    ball: str
    radius_px: float
    flags: tuple[str, ...] = ()

    @property
    def wide_px(self) -> float:
        return 2 * self.radius_px


@dataclass(frozen=True, eq=False)
class _Plain:
    ball: str
    radius_px: float
    flags: tuple[str, ...] = ()


def test_a_record_is_made_and_read_as_a_frozen_dataclass_is():
    one = _Sighting("green", 20.0)
    assert (one.ball, one.radius_px, one.flags, one.wide_px) == ("green", 20.0, (), 40.0)
    assert [f.name for f in fields(one)] == [f.name for f in fields(_Plain)]
    assert inspect.signature(_Sighting) == inspect.signature(_Plain)
    assert repr(one) == repr(_Plain("green", 20.0)).replace("_Plain", "_Sighting")
    assert replace(one, flags=("odd",)).flags == ("odd",)
    assert one != _Sighting("green", 20.0)


def test_a_record_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        _Sighting("green", 20.0).ball = "red"
    with pytest.raises(TypeError, match="radius_px"):
        _Sighting("green")


def test_fields_that_need_more_than_being_set_are_refused():
    with pytest.raises(TypeError, match="taken as they are given"):

        @record
        class _Listed:
            names: list[str] = field(default_factory=list)

    with pytest.raises(TypeError, match="taken as they are given"):

        @record
        class _Checked:
            size: float

            def __post_init__(self) -> None:
                raise ValueError
