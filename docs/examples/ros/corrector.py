"""Asks `measure estimate` for corrections by UDP; needs Python 3.8 and nothing else."""

import math
import socket
import struct

_STATE = struct.Struct("<4sQdH")
_ANSWER = struct.Struct("<4sQdB9f")


class Corrector:
    """One robot's running trajectory: states go out, corrections come back."""

    def __init__(self, host="127.0.0.1", port=47118, timeout_s=0.005):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(timeout_s)
        self._socket.connect((host, port))
        self._sequence = -1

    def ask(self, state, time_s):
        """The error (x, y, z) in mm and its covariance, six numbers in mm^2; None if none came.

        The covariance is xx, xy, xz, yy, yz, zz. States unlike the training are not corrected.
        """
        self._sequence += 1
        head = _STATE.pack(b"TBs1", self._sequence, time_s, len(state))
        self._socket.send(head + struct.pack(f"<{len(state)}f", *state))
        while True:
            try:
                data = self._socket.recv(65507)
            except OSError:  # too late, or nobody listens
                return None
            if len(data) != _ANSWER.size:
                continue
            magic, sequence, _, status, *numbers = _ANSWER.unpack(data)
            if magic == b"TBe1" and sequence == self._sequence:
                return (numbers[:3], numbers[3:]) if status == 0 else None


def state_of(names, joints, tip_mm):
    """A state: the joints in the robot's order, then the tip; None while something is missing."""
    held = {name: joints.position[i] for i, name in enumerate(joints.name)}
    state = [held.get(name, math.nan) for name in names] + list(tip_mm or (math.nan,))
    return None if any(map(math.isnan, state)) else state


def correct(message, tip, answer):
    """Fill a PoseWithCovarianceStamped from the robot's own PoseStamped and an answer."""
    error_mm, (xx, xy, xz, yy, yz, zz) = answer
    message.header = tip.header
    message.pose.pose.orientation = tip.pose.orientation
    for i, axis in enumerate("xyz"):
        place = getattr(tip.pose.position, axis)
        setattr(message.pose.pose.position, axis, place + 1e-3 * error_mm[i])
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    covariance = [0.0] * 36
    for i, row in enumerate(rows):
        covariance[6 * i : 6 * i + 3] = [1e-6 * value for value in row]
    message.pose.covariance = covariance
    return message
