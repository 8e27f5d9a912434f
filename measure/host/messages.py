"""Poses in the formats of other programs: names of bodies, and messages of ROS 2.

Where a format restricts names, one rule serves every sink and export. Messages are in metres and
radians, serialised (CDR) by rosbags.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import RunError
from measure.geometry import RigidTransform

_LETTERS = 60  # ROS advises short names; what is longer is cut, and numbered where alike


def plain_name(name: str, nothing: str = "body") -> str:
    """A name of ASCII letters, digits and `_`, which begins with a letter.

    Accents are dropped, all else becomes `_`; `nothing` stands for a name without anything
    left, and before one that begins with a digit.
    """
    plain = unicodedata.normalize("NFKD", name.replace("ß", "ss")).encode("ascii", "ignore")
    word = re.sub("[^A-Za-z0-9]+", "_", plain.decode()).strip("_")[:_LETTERS]
    return word if word[:1].isalpha() else "_".join(filter(None, (nothing, word)))


def plain_names(names: Iterable[str], nothing: str = "body") -> dict[str, str]:
    """`plain_name` of each; of names that would be alike the later ones end in a number."""
    out: dict[str, str] = {}
    for name in dict.fromkeys(names):
        word = made = plain_name(name, nothing)
        number = 1
        while made in out.values():
            number += 1
            made = f"{word}_{number}"
        out[name] = made
    return out


POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
METRES = np.array([1e-3] * 3 + [1.0] * 3)
"""A pose's covariance in metres and radians is ours times their outer product."""
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_END_S = 2**31


class RosMessages:
    """Makes messages and serialises them."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)

    def cdr(self, kind: str, values: Mapping[str, Any]) -> bytes:
        """A message of a type such as "geometry_msgs/msg/Pose", serialised."""
        return bytes(self.store.serialize_cdr(self._message(kind, values), kind))

    def poses(
        self, time_s: float, frame: str, child: str, pose: RigidTransform, covariance: Floats
    ) -> Iterator[tuple[str, bytes]]:
        """Type and content of a pose with its (6, 6) covariance in mm, and of its transform.

        ROS orders a pose covariance as we do (x y z, then rotations about the fixed axes).
        """
        head = header(time_s, frame)
        place, turn = letters("xyz", pose.translation / 1000), letters("wxyz", pose.quat_wxyz)
        spread = (covariance * np.outer(METRES, METRES)).reshape(36)
        stated = {"pose": {"position": place, "orientation": turn}, "covariance": spread}
        yield POSE, self.cdr(POSE, {"header": head, "pose": stated})
        moved = {"translation": place, "rotation": turn}
        transform = {"header": head, "child_frame_id": child, "transform": moved}
        yield TF, self.cdr(TF, {"transforms": [self._message(_TRANSFORM, transform)]})

    def _message(self, kind: str, values: Mapping[str, Any]) -> Any:
        """A message; parts of it may be mappings too."""
        kinds = dict(self.store.get_msgdef(kind).fields)
        made = {
            name: self._message(kinds[name][1], value) if isinstance(value, Mapping) else value
            for name, value in values.items()
        }
        return self.store.types[kind](**made)


def header(time_s: float, frame: str) -> dict[str, Any]:
    """The header of a message."""
    sec, nanosec = divmod(nanoseconds(time_s), 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def letters(names: str, values: Floats) -> dict[str, float]:
    """Numbers that are called by single letters."""
    return dict(zip(names, values.tolist(), strict=True))


def nanoseconds(time_s: float) -> int:
    """A time as ROS counts it; RunError: it knows no such time."""
    if not 0 <= time_s < _END_S:
        raise RunError(
            f"ROS knows no time {time_s:g} s, only those from 0 to {_END_S}: shift the session's "
            "clocks with time_offset_s, or export another format"
        )
    return round(time_s * 1e9)
