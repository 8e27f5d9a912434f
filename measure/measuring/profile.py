"""A profile: which plugin does which stage, how tracking works, and all their settings."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

STAGES = ("detector", "triangulator", "solver", "tracking")


class Profile(BaseModel):
    """A named choice of stages; `measure/profiles/*.toml` hold those that come with the program.

    Attributes:
        name: how a user selects it.
        detector: name of the detector plugin.
        triangulator: name of the triangulator plugin.
        solver: name of the pose-solver plugin.
        tracking: "frame-update" (the paper's section II.D) or "predictive" (constant velocity in SE(3)).
        own_times: whether each image counts at its own time (else a frame set is one instant).
        neighbours: whether a pose is solved again once the next one gives its velocity (one frame late).
        settings: by stage name, the settings that differ from the defaults.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    detector: str
    triangulator: str
    solver: str
    tracking: Literal["frame-update", "predictive"]
    own_times: bool
    neighbours: bool
    settings: dict[Literal["detector", "triangulator", "solver", "tracking"], dict[str, Any]] = (
        Field(default_factory=dict)
    )

    def with_stage(self, stage: str, name: str) -> Profile:
        """The same profile with another plugin for one stage, and that stage's settings at default."""
        settings = {key: value for key, value in self.settings.items() if key != stage}
        return self.model_copy(update={stage: name, "settings": settings})

    def with_setting(self, stage: str, name: str, value: Any) -> Profile:
        """The same profile with one setting changed."""
        settings = {key: dict(values) for key, values in self.settings.items()}
        settings.setdefault(stage, {})[name] = value  # type: ignore[call-overload]
        return self.model_copy(update={"settings": settings})
