"""Conformance tests of plugins of every kind, and assertions that several kinds share."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import ValidationError

from measure.arrays import Floats
from measure.host import Plugin, Settings, describe_settings
from measure.host.interfaces import NAME

UNITS = {"", "px", "mm", "m", "deg", "rad", "s", "ms", "Hz", "%", "votes", "px²", "mm²"}
UNITS |= {"mm/s", "rad/s", "mm/s^2", "rad/s^2"}
"""Units a setting may have; anything else is most likely a mistake."""


class PluginConformance:
    """Tests of a plugin of any kind; the classes of the kinds build on it."""

    plugin: ClassVar[type[Plugin]]  # the class under test
    # settings to test it with, where they differ from the defaults.
    settings: ClassVar[Mapping[str, Any]] = {}

    @property
    def config(self) -> Settings:
        """The settings to build the plugin with."""
        return self.plugin.Config.model_validate(dict(self.settings))

    def test_its_name_can_be_typed(self) -> None:
        """Lower case, words joined by "-"."""
        name = self.plugin.name
        assert NAME.fullmatch(name), f"bad name: {name!r}"

    def test_it_says_what_it_does(self) -> None:
        """The docstring's first line is a sentence: `measure plugins list` shows it."""
        first = (inspect.cleandoc(self.plugin.__doc__ or "")).partition("\n")[0]
        assert first.endswith("."), f"the docstring's first line is no sentence: {first!r}"

    def test_its_settings_are_described(self) -> None:
        """Each has a description and a unit: `measure plugins show` and the docs print them."""
        for item in describe_settings(self.plugin.Config):
            assert item.description, f"setting {item.name} has no description"
            assert item.unit in UNITS, f"setting {item.name} has an unknown unit: {item.unit!r}"

    def test_a_misspelt_setting_is_refused(self) -> None:
        """A typing error must not silently leave the default in place."""
        try:
            self.plugin.Config.model_validate({**self.settings, "no_such_setting": 1})
        except ValidationError:
            return
        raise AssertionError("Config accepts a setting that does not exist")

    def test_its_settings_cannot_be_changed(self) -> None:
        """A run folder records the settings at the start: they must still hold at the end."""
        assert self.plugin.Config.model_config.get("frozen"), "Config is not frozen"


def assert_same(actual: Any, expected: Any, what: str) -> None:
    """Compare results field by field, arrays bit by bit (NaN equals NaN).

    AssertionError: they differ; the message says where.
    """
    assert type(actual) is type(expected), f"{what}: {type(actual)} instead of {type(expected)}"
    if isinstance(expected, np.ndarray):
        same = np.array_equal(actual, expected, equal_nan=expected.dtype.kind == "f")
        assert same, f"{what}: {actual} instead of {expected}"
    elif dataclasses.is_dataclass(expected):
        for field in dataclasses.fields(expected):
            if not callable(getattr(expected, field.name)):
                assert_same(
                    getattr(actual, field.name),
                    getattr(expected, field.name),
                    f"{what}.{field.name}",
                )
    elif isinstance(expected, dict):
        assert_same(list(actual), list(expected), f"keys of {what}")
        for key in expected:
            assert_same(actual[key], expected[key], f"{what}[{key!r}]")
    elif isinstance(expected, list | tuple):
        assert len(actual) == len(expected), f"{what}: {len(actual)} instead of {len(expected)}"
        for i, (one, other) in enumerate(zip(actual, expected, strict=True)):
            assert_same(one, other, f"{what}[{i}]")
    elif isinstance(expected, float) and np.isnan(expected):
        assert np.isnan(actual), f"{what}: {actual} instead of NaN"
    else:
        assert actual == expected, f"{what}: {actual!r} instead of {expected!r}"


def assert_covariance(covariance: Floats, size: int, what: str) -> None:
    """A covariance is finite, symmetric and positive definite; AssertionError: it is not."""
    assert isinstance(covariance, np.ndarray), f"{what}: covariance is {type(covariance)}"
    assert covariance.shape == (size, size), f"{what}: covariance of shape {covariance.shape}"
    assert np.all(np.isfinite(covariance)), f"{what}: covariance is not finite: {covariance}"
    scale = np.abs(covariance).max()
    skew = np.abs(covariance - covariance.T).max()
    assert skew <= 1e-9 * scale, f"{what}: covariance is not symmetric (by {skew:.2g})"
    spectrum = np.linalg.eigvalsh(covariance)
    assert spectrum[0] > 0, f"{what}: covariance is not positive definite: {spectrum}"
