"""From poses and robot states to an estimator of the position error, and its use online."""

from measure.learning import files, sweeping
from measure.learning.assemble import AssemblySettings, PoseTrack, TrajectoryFacts, assemble
from measure.learning.clock import estimate_offset
from measure.learning.datagrams import AnswerPacket, StatePacket, TruePacket
from measure.learning.guard import Counters, GuardedModel, Refusal
from measure.learning.offline import correct_file, follower_of, read_states, rezero
from measure.learning.offsets import DriftMonitor, OffsetFollower, Zeroing, fit_zeroing
from measure.learning.scores import (
    EstimatorEvaluation,
    Importance,
    Score,
    ablate,
    evaluate,
    field_groups,
)
from measure.learning.server import EstimateClient, EstimateServer
from measure.learning.simulated import PAPER_MINUTES, PAPER_PAIRS, simulated_dataset
from measure.learning.splits import Split, join, same_robot, split_as_trained, split_by_trajectory
from measure.learning.sweeping import SweepState
from measure.learning.training import Trained, train

__all__ = [
    "PAPER_MINUTES", "PAPER_PAIRS", "AnswerPacket", "AssemblySettings", "Counters", "DriftMonitor",
    "EstimateClient", "EstimateServer", "EstimatorEvaluation", "GuardedModel", "Importance",
    "OffsetFollower", "PoseTrack", "Refusal", "Score", "Split", "StatePacket", "SweepState",
    "Trained", "TrajectoryFacts", "TruePacket", "Zeroing", "ablate", "assemble",
    "correct_file", "estimate_offset", "evaluate", "field_groups", "files", "fit_zeroing",
    "follower_of", "join", "read_states", "rezero", "same_robot", "simulated_dataset",
    "split_as_trained", "split_by_trajectory", "sweeping", "train",
]  # fmt: skip
