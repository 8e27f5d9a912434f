"""What a notebook calls to correct a robot, one function an action."""

from measure_learning.api.correcting import (
    POSES,
    choose_poses,
    correct_simulated_robot,
    estimate_file,
    estimate_online,
    model_file,
    recalibrate,
    rezero,
    robot_recording,
    shipped_model,
)
from measure_learning.api.pairing import (
    RenderOptions,
    RobotLogs,
    RunFacts,
    SimulationOptions,
    check_other_file,
    make_dataset,
    other_file,
    register,
    simulate_dataset,
    simulate_recording,
)
from measure_learning.api.training import (
    SweepOptions,
    TrainOptions,
    ablate,
    parse_settings,
    sweep,
    train,
)

__all__ = [
    "POSES", "RenderOptions", "RobotLogs", "RunFacts", "SimulationOptions", "SweepOptions",
    "TrainOptions", "ablate", "check_other_file", "choose_poses", "correct_simulated_robot",
    "estimate_file", "estimate_online", "make_dataset", "model_file", "other_file",
    "parse_settings", "recalibrate", "register", "rezero", "robot_recording", "shipped_model",
    "simulate_dataset", "simulate_recording", "sweep", "train",
]  # fmt: skip
