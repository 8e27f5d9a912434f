from measure.calibration.boards import Board, Charuco, Chessboard, Corners
from measure.calibration.by_body.waving import BodyWave
from measure.calibration.capture import Capture, open_capture
from measure.calibration.extrinsics import fit_rig
from measure.calibration.intrinsics import calibrate_lens
from measure.calibration.markers import find_markers
from measure.calibration.printing import Sheet, target_sheet, write_sheet
from measure.calibration.procedure import JOINT, RigCalibration, calibrate_capture
from measure.calibration.refining.procedure import (
    RefinedRig,
    judge_refinement,
    refine_measured,
    rough_cameras,
)
from measure.calibration.refining.refine import RefineSettings, refine_rig
from measure.calibration.targets import MarkerField, read_board
from measure.calibration.verdict import Verdict, camera_rows, judge, judgement_lines, provenance
from measure.calibration.views import choose_views, find_views
from measure.calibration.waving import BoardWave, WaveState

__all__ = [
    "JOINT", "Board", "BoardWave", "BodyWave", "Capture", "Charuco", "Chessboard", "Corners",
    "MarkerField", "RefineSettings", "RefinedRig", "RigCalibration", "Sheet", "Verdict",
    "WaveState", "calibrate_capture", "calibrate_lens", "camera_rows", "choose_views",
    "find_markers", "find_views", "fit_rig", "judge", "judge_refinement", "judgement_lines",
    "open_capture", "provenance", "read_board", "refine_measured", "refine_rig",
    "rough_cameras", "target_sheet", "write_sheet",
]  # fmt: skip
