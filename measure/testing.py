"""Conformance kit and scenes for plugin authors."""

from __future__ import annotations
