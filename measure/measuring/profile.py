"""A profile: which plugin does which stage, how tracking works, and all their settings."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Stage = Literal["detector", "triangulator", "solver", "tracking"]


class Profile(BaseModel):
    """A named choice of stages; `measure/profiles/*.toml` hold those that come with the program."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str  # how a user selects it
    detector: str  # name of the detector plugin
    triangulator: str  # name of the triangulator plugin
    solver: str  # name of the pose-solver plugin
    tracking: str  # "frame-update" (the paper's section II.D), "predictive" or "memoryless"
    # whether each image counts at its own time (else all images of a frame set count at one
    # instant).
    per_image_timestamps: bool
    # whether poses wait for later ones: each is solved again with the motion of a spline through
    # the poses before and after it.
    smoothing: bool
    # whether, after a search of whole frames, the balls are measured once more.
    remeasure_after_search: bool = True
    # by stage name, the settings that differ from the defaults.
    settings: dict[Stage, dict[str, Any]] = Field(default_factory=dict)

    def with_stage(self, stage: Stage, name: str) -> Profile:
        """The same profile with another plugin for one stage, at its default settings."""
        settings = {key: value for key, value in self.settings.items() if key != stage}
        return self.model_copy(update={stage: name, "settings": settings})

    def with_setting(self, stage: Stage, name: str, value: Any) -> Profile:
        """The same profile with one setting changed."""
        settings = {key: dict(values) for key, values in self.settings.items()}
        settings.setdefault(stage, {})[name] = value
        return self.model_copy(update={"settings": settings})
