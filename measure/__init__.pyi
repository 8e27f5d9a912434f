from measure.api.objects import Body, CalibratedRig, Pose, Rig, Run, calibrate, measure, stream

__all__ = ["Body", "CalibratedRig", "Pose", "Rig", "Run", "calibrate", "measure", "stream"]
