"""Settings: one model for validation, help and docs; messages a user can act on."""

from __future__ import annotations

from typing import Literal

import pydantic
import pytest

from measure.errors import ConfigError
from measure.host import Setting, Settings, describe_settings, setting
from measure.host.settings import read_settings


class Example(Settings):
    rays: int = setting(64, "Rays per ball.", ge=8)
    reach_px: float = setting(12.0, "How far to look.", unit="px", gt=0)
    curve: Literal["srgb", "linear"] = setting("srgb", "The camera's tone curve.")
    refine: bool = setting(True, "Whether to refine.")


class Needy(Settings):
    path: str = setting(..., "Which file.")


def read(**values):
    return read_settings(Example, values, "detector 'x'")


def test_text_from_a_command_line_is_understood():
    assert read(rays="32", reach_px="7.5", refine="false") == Example(
        rays=32, reach_px=7.5, refine=False
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"ray": 3}, "detector 'x': unknown setting 'ray'; it has rays, reach_px, curve, refine"),
        ({"rays": 3}, "detector 'x': 'rays': input should be greater than or equal to 8, got 3"),
        ({"rays": "many"}, "'rays': input should be a valid integer"),
        ({"rays": 8.5}, "'rays': input should be a valid integer"),
        ({"curve": "log"}, "'curve': input should be 'srgb' or 'linear', got 'log'"),
        ({"reach_px": "nan"}, "'reach_px': input should be a finite number, got 'nan'"),
        ({"reach_px": "inf"}, "'reach_px': input should be a finite number, got 'inf'"),
        ({"rays": 3, "reach_px": 0}, "(and 1 more)"),
    ],
)
def test_messages_name_the_owner_the_setting_and_the_value(values, message):
    with pytest.raises(ConfigError) as caught:
        read(**values)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "pydantic" not in str(caught.value)


def test_no_settings_says_so():
    with pytest.raises(ConfigError, match="unknown setting 'a'; it has no settings"):
        read_settings(Settings, {"a": 1}, "solver 'z'")


def test_settings_cannot_be_changed():
    with pytest.raises(pydantic.ValidationError, match="frozen"):
        Example().rays = 3


def test_the_description_is_for_people():
    described = describe_settings(Example)
    assert described[1] == Setting("reach_px", "float", "12.0", "px", "How far to look.")
    assert described[2].type == "Literal['srgb', 'linear']"
    assert described[2].default == "'srgb'"
    assert describe_settings(Needy)[0].default == "required"
