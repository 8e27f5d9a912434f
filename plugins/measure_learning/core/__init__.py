"""From poses and robot states to an estimator of the position error, and its use online."""

from measure_learning.core import files, sweeping
from measure_learning.core.assemble import AssemblySettings, PoseTrack, TrajectoryFacts, assemble
from measure_learning.core.clock import estimate_offset
from measure_learning.core.correction import (
    Counters,
    GuardedModel,
    Refusal,
    correct_file,
    follower_of,
    read_states,
    rezero,
)
from measure_learning.core.offsets import DriftMonitor, OffsetFollower, Zeroing, fit_zeroing
from measure_learning.core.recalibration import choose_poses
from measure_learning.core.scores import (
    EstimatorEvaluation,
    Importance,
    Score,
    Split,
    ablate,
    evaluate,
    field_groups,
    join,
    same_robot,
    split_as_trained,
    split_by_trajectory,
)
from measure_learning.core.server import (
    AnswerPacket,
    EstimateClient,
    EstimateServer,
    StatePacket,
    TruePacket,
)
from measure_learning.core.simulated import PAPER_MINUTES, PAPER_PAIRS, LabelKind, simulated_dataset
from measure_learning.core.sweeping import SweepState
from measure_learning.core.training import Trained, train

__all__ = [
    "PAPER_MINUTES", "PAPER_PAIRS", "AnswerPacket", "AssemblySettings", "Counters", "DriftMonitor",
    "EstimateClient", "EstimateServer", "EstimatorEvaluation", "GuardedModel", "Importance",
    "LabelKind", "OffsetFollower", "PoseTrack", "Refusal", "Score", "Split", "StatePacket",
    "SweepState", "Trained", "TrajectoryFacts", "TruePacket", "Zeroing", "ablate", "assemble",
    "choose_poses", "correct_file", "estimate_offset", "evaluate", "field_groups", "files",
    "fit_zeroing", "follower_of", "join", "read_states", "rezero", "same_robot",
    "simulated_dataset", "split_as_trained", "split_by_trajectory", "sweeping", "train",
]  # fmt: skip
