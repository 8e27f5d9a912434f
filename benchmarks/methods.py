"""The methods that are compared, each as a pipeline."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.baselines import BASELINES, MaskDetector
from measure.api import build_pipeline, load_profile
from measure.host import PoseSolver, Registry, Tracker, Triangulator
from measure.host.settings import Settings
from measure.measuring import Pipeline, Stages
from measure.session import Session


@dataclass(frozen=True)
class Method:
    """A name, and either a profile with its changed stages or a baseline detector."""

    name: str
    profile: str = ""
    solver: str | None = None
    baseline: type[MaskDetector] | None = None

    def pipeline(self, session: Session, registry: Registry) -> Pipeline:
        """A fresh pipeline for a session."""
        if self.baseline is not None:
            return _baseline_pipeline(self.baseline, session, registry)
        profile = load_profile(self.profile)
        if self.solver is not None:
            profile = profile.with_stage("solver", self.solver)
        return build_pipeline(profile, registry, session.body, session.cameras)


DEFAULT = "precise profile"
"""The default profile of the program."""
METHODS = (
    Method("paper profile", profile="paper"),
    *(Method(f"{baseline.name} + kabsch", baseline=baseline) for baseline in BASELINES),
    Method("outline + kabsch", profile="precise", solver="kabsch"),
    Method(DEFAULT, profile="precise"),
)


def _baseline_pipeline(
    detector: type[MaskDetector], session: Session, registry: Registry
) -> Pipeline:
    """A baseline detector with the textbook's triangulation and alignment, every frame anew."""
    body, cameras = session.body, session.cameras
    stages = Stages(
        detectors={c.name: detector(Settings(), body, c) for c in cameras},
        tracker=registry.build(Tracker, "memoryless", {}, body=body, cameras=cameras),
        triangulator=registry.build(Triangulator, "dlt", {}),
        solver=registry.build(PoseSolver, "kabsch", {}, body=body),
        per_image_timestamps=False,
        smoothing=False,
        remeasure_after_search=False,
    )
    return Pipeline(body, cameras, stages)
