"""Profiles: read by name or file, changed by a user's choices, built into a pipeline."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

from measure.errors import ConfigError
from measure.host import Detector, PoseSolver, Registry, Tracker, Triangulator
from measure.measuring import Pipeline, Profile, Stages
from measure.measuring.pipeline import Stage
from measure.model import Body, Camera
from measure.reading import parse_toml
from measure.session import load_toml

DEFAULT_PROFILE = "precise"
RUN_FILE = "run.toml"


def profile_names() -> list[str]:
    """Names of the profiles that come with the program."""
    folder = resources.files("measure") / "profiles"
    return sorted(Path(f.name).stem for f in folder.iterdir() if f.name.endswith(".toml"))


def load_profile(name: Profile | str = DEFAULT_PROFILE) -> Profile:
    """A profile that comes with the program, by name, or any by the path of its TOML file.

    A run's `run.toml` serves as well: it holds the profile the run was made with. A profile is
    given back as it is.
    """
    if isinstance(name, Profile):
        return name
    if Path(name).name == RUN_FILE:
        return load_toml(name, _ProfileOfRun, ConfigError).profile
    if name.endswith(".toml"):
        return load_toml(name, Profile, ConfigError)
    if name not in profile_names():
        near = difflib.get_close_matches(name, profile_names(), n=1)
        hint = f"'{near[0]}'" if near else f"one of {', '.join(profile_names())}"
        raise ConfigError(
            f"no profile is called '{name}'; did you mean {hint}, or the path of a .toml file?"
        )
    with resources.as_file(resources.files("measure") / "profiles" / f"{name}.toml") as path:
        return load_toml(path, Profile, ConfigError)


class _ProfileOfRun(BaseModel):
    """The part of a `run.toml` that is used here."""

    profile: Profile


def choose(
    profile: Profile, stages: Mapping[Stage, str | None], settings: Iterable[str] = ()
) -> Profile:
    """Apply a user's choices: plugins by stage, and "STAGE.NAME=VALUE", VALUE in TOML or bare."""
    for stage, name in stages.items():
        if name is not None and name != getattr(profile, stage):
            profile = profile.with_stage(stage, name)
    for text in settings:
        profile = profile.with_setting(*_parse_setting(text))
    return profile


def _parse_setting(text: str) -> tuple[Stage, str, Any]:
    key, equals, value = text.partition("=")
    stage, dot, name = key.strip().partition(".")
    known: tuple[Stage, ...] = get_args(Stage)
    if not (equals and dot and name):
        raise ConfigError(f"--set {text}: expected STAGE.NAME=VALUE, such as detector.rays=128")
    for candidate in known:
        if candidate == stage:
            return candidate, name, parse_value(value)
    raise ConfigError(f"--set {text}: no stage is called '{stage}'; there is {', '.join(known)}")


def parse_value(text: str) -> Any:
    """A setting's value as it is typed: TOML, or else a bare word."""
    try:
        return parse_toml(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def build_detectors(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> dict[str, Detector]:
    """The detector of a profile for each camera, by name; raises as `build_pipeline` does."""
    settings = profile.settings.get("detector", {})
    return {
        c.name: registry.build(Detector, profile.detector, settings, body=body, camera=c)
        for c in cameras
    }


def build_pipeline(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Pipeline:
    """Build every stage of a profile for a body and its cameras.

    PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body. ConfigError:
    settings that do not fit, or a solver of outlines with a detector of none.
    """
    settings = profile.settings
    detectors = build_detectors(profile, registry, body, cameras)
    solver = registry.build(PoseSolver, profile.solver, settings.get("solver", {}), body=body)
    if solver.requires_outlines and any(d.provides_outlines is False for d in detectors.values()):
        others = " or ".join(name for name in registry.names("solver") if name != profile.solver)
        raise ConfigError(
            f"solver '{profile.solver}' fits outlines, and detector '{profile.detector}' measures "
            f"none: take another solver with it (--solver {others})"
        )
    stages = Stages(
        detectors=detectors,
        tracker=registry.build(
            Tracker, profile.tracking, settings.get("tracking", {}), body=body, cameras=cameras
        ),
        triangulator=registry.build(
            Triangulator, profile.triangulator, settings.get("triangulator", {})
        ),
        solver=solver,
        per_image_timestamps=profile.per_image_timestamps,
        smoothing=profile.smoothing,
        remeasure_after_search=profile.remeasure_after_search,
    )
    return Pipeline(body, cameras, stages)
