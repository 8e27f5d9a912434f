"""Rigid bodies that commercial trackers export: files made of known poses give these poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from measure.errors import SessionError
from measure.geometry import RigidTransform
from measure.session import read_trajectory

TIMES_S = np.arange(6) / 100
RNG = np.random.default_rng(3)
TURNS = Rotation.from_rotvec(RNG.normal(size=(6, 3)) * [[0.0], *[[1.0]] * 5])
PLACES_MM = RNG.uniform(-900, 900, (6, 3))


def lines(rows, separator=","):
    return "\n".join(separator.join(str(cell) for cell in row) for row in rows) + "\n"


def motive(rotation_type="Quaternion", unit="Meters", scale=1e-3, label=False):
    """Two bodies and a marker; the first body is not seen in the last frame."""
    turned = (
        TURNS.as_quat()
        if rotation_type == "Quaternion"
        else TURNS.as_euler(rotation_type, degrees=True)
    )
    axes = ["X", "Y", "Z", "W"][: turned.shape[1]]
    if rotation_type != "Quaternion":
        turned = turned[:, [rotation_type.index(axis) for axis in axes]]
    n = len(axes)
    one = ["Rotation"] * n + ["Position"] * 3 + ["Mean Marker Error"]
    rows = [
        ["Format Version", "1.23", "Take Name", "T", "Capture Frame Rate", "100.000000",
         "Rotation Type", rotation_type, "Length Units", unit, "Coordinate Space", "Global"],
        [],
        ["", "Type" if label else "", *["Rigid Body"] * (2 * (n + 4)), *["Marker"] * 3],
        ["", "Name" if label else "", *["tool"] * (n + 4), *["other"] * (n + 4), *["m:1"] * 3],
        ["", "ID" if label else "", *["12AB"] * (2 * (n + 4) + 3)],
        ["", "", *one, *one, *["Position"] * 3],
        ["Frame", "Time (Seconds)", *[*axes, "X", "Y", "Z", ""] * 2, "X", "Y", "Z"],
    ]  # fmt: skip
    for k, time_s in enumerate(TIMES_S):
        own = [*turned[k], *(scale * PLACES_MM[k]), 0.1]
        other = [*turned[k], *(scale * PLACES_MM[k] + 1), 0.1]
        rows.append([k, f"{time_s:.6f}", *(own if k < 5 else [""] * len(own)), *other, 0, 0, 0])
    return lines(rows)


def vicon(quaternion=False, unit="rad", kind="Objects"):
    turned = TURNS.as_quat() if quaternion else TURNS.as_rotvec(degrees=unit == "deg")
    headings = ["RX", "RY", "RZ", "RW"][: turned.shape[1]]
    width = len(headings) + 3
    rows = [
        [kind],
        [100],
        ["", "", "Global Angle tool:tool", *[""] * (width - 1), "other:other"],
        ["Frame", "Sub Frame", *[*headings, "TX", "TY", "TZ"] * 2],
        ["", "", *[*[unit] * len(headings), "mm", "mm", "mm"] * 2],
        *([k + 1, 0, *[*turned[k], *PLACES_MM[k]] * 2] for k in range(5)),
        [6, 0, *[""] * width, *turned[5], *PLACES_MM[5]],
    ]
    return lines(rows)


def qualisys():
    """The columns of the matrix one after the other; a lost body is all zeros."""
    matrices = np.swapaxes(TURNS.as_matrix(), 1, 2).reshape(-1, 9)
    one = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{k}]" for k in range(9))]
    head = [
        ["NO_OF_FRAMES", 6], ["NO_OF_BODIES", 2], ["FREQUENCY", 100], ["DATA_INCLUDED", "6D"],
        ["BODY_NAMES", "tool", "other"], ["Frame", "Time", "tool", *one, "other", *one],
    ]  # fmt: skip
    head[-1] = ["Frame", "Time", *one, *one]
    for k, time_s in enumerate(TIMES_S):
        own = [*PLACES_MM[k], 0, 0, 0, 0.4, *matrices[k]]
        head.append([k + 1, f"{time_s:.5f}", *(own if k < 5 else [0.0] * 16), *own])
    return lines(head, "\t")


def ndi():
    cells = ["Frame", "State", "Q0", "Qx", "Qy", "Qz", "Tx", "Ty", "Tz", "Error"]
    quaternions = TURNS.as_quat(scalar_first=True)
    rows = [["Tools", "Port 1", *cells, "Port 2", *cells]]
    for k in range(6):
        own = [round(60 * TIMES_S[k], 6), "OK", *quaternions[k], *PLACES_MM[k], 0.1]
        lost = [own[0], "Missing", *[-3.697314e28] * 7, ""]
        rows.append([2, "tool.rom", *(own if k < 5 else lost), "other.rom", *own])
    return lines(rows)


FILES = {
    "Motive": (motive(), "tool"),
    "Motive, mm, labelled rows": (motive(unit="Millimeters", scale=1, label=True), "tool"),
    "Motive, angles XYZ": (motive("XYZ"), "tool"),
    "Motive, angles YZX in cm": (motive("YZX", "Centimeters", 0.1), "tool"),
    "Vicon Tracker": (vicon(), "tool:tool"),
    "Vicon Nexus, deg": (vicon(unit="deg", kind="Segments"), "tool:tool"),
    "Vicon, quaternions": (vicon(quaternion=True), "tool:tool"),
    "Qualisys": (qualisys(), "tool"),
    "NDI": (ndi(), "Port 1"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_body_is_read_as_it_was(tmp_path, name):
    text, body = FILES[name]
    (tmp_path / "truth").write_text(text)
    found = read_trajectory(tmp_path / "truth", body=body)
    np.testing.assert_allclose(found.times_s, TIMES_S[:5], atol=1e-9)
    true = RigidTransform(TURNS.as_matrix()[:5], PLACES_MM[:5])
    assert np.abs(found.world_from_body.difference(true)).max() < 1e-9


@pytest.mark.parametrize("name", FILES)
def test_of_several_bodies_one_must_be_named(tmp_path, name):
    text, body = FILES[name]
    (tmp_path / "truth").write_text(text)
    with pytest.raises(SessionError, match=rf"holds the rigid bodies {body}, .*--truth-body"):
        read_trajectory(tmp_path / "truth")
    with pytest.raises(SessionError, match="none of them is called 'hand'"):
        read_trajectory(tmp_path / "truth", body="hand")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (motive(unit="Furlongs"), "lengths in 'Furlongs', expected mm"),
        (motive().replace("Rigid Body", "Marker"), "holds no rigid body"),
        (
            motive().replace("0,0.000000,", "0,0.000000,9"),
            ":8: not a rotation: the quaternion's length",
        ),
        (motive().replace("0,0.000000,", "0,0.000000,x"), ":8: not numbers: 0.000000,"),
        (vicon().replace("\n100\n", "\nfast\n"), "could not convert string to float: 'fast'"),
        (qualisys().replace("1\t0.00000\t", "1\t0.00000\t1\t"), ":7: not a rotation"),
    ],
    ids=["unit", "no body", "quaternion", "no number", "rate", "matrix"],
)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, text, said):
    (tmp_path / "truth").write_text(text)
    body = "tool:tool" if text.startswith("Objects") else "tool"
    with pytest.raises(SessionError) as refused:
        read_trajectory(tmp_path / "truth", body=body)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
