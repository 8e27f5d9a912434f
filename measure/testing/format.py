"""Conformance tests of formats of other programs."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from measure.errors import CalibrationError, SessionError
from measure.session import Calibration, Format, StatedRig, TrackedBody
from measure.testing.scenes import example

_NOT_OURS = ("", "{}", "a,b\n1,2\n", "x = 1\n", "<a></a>", "0 1 2 3\n", "\x00\x01")


class FormatConformance:
    """Tests of a format: whose file is whose, and what is written is read again."""

    format: ClassVar[Format]  # under test
    calibrations: ClassVar[Mapping[str, str]] = {}  # texts of its files, by their names
    truths: ClassVar[Mapping[str, str]] = {}  # the same, of poses over time

    def test_it_says_what_it_is(self) -> None:
        """Its name can be typed, and a line says what it does."""
        name = self.format.name
        assert name, "no name"
        assert name == name.lower(), f"bad name: {name!r}"
        assert " " not in name, f"bad name: {name!r}"
        assert self.format.does, "nothing says what it does"

    def test_it_does_something(self) -> None:
        """Each has at least one action."""
        one = self.format
        actions = (one.read_calibration, one.read_truth, one.write_calibration, one.write_run)
        assert any(actions), "it reads nothing and writes nothing"

    def test_files_of_others_are_left_to_others(self) -> None:
        """A reader gives None, and raises nothing, for what is not its own."""
        for text in _NOT_OURS:
            if self.format.read_calibration is not None:
                found = self.format.read_calibration(Path("file"), text)
                assert found is None, f"takes {text!r} for a calibration"
            if self.format.read_truth is not None:
                bodies = self.format.read_truth(Path("file"), text, SessionError)
                assert bodies is None, f"takes {text!r} for poses"

    def test_its_calibrations_are_read(self) -> None:
        """As rigs that become ours."""
        for name, text in self.calibrations.items():
            assert self.format.read_calibration is not None, "it reads no calibration"
            rig = self.format.read_calibration(Path(name), text)
            assert isinstance(rig, StatedRig), f"{name}: not a StatedRig: {rig!r}"
            assert rig.cameras, f"{name}: no camera in it"

    def test_its_poses_are_read(self) -> None:
        """As rigid bodies by name, with rising times."""
        for name, text in self.truths.items():
            assert self.format.read_truth is not None, "it reads no poses"
            bodies = self.format.read_truth(Path(name), text, SessionError)
            assert bodies, f"{name}: no body in it"
            for body in bodies.values():
                assert isinstance(body, TrackedBody), f"{name}: not a TrackedBody: {body!r}"
                rows, lines = body.read(Path(name), SessionError)
                assert rows.shape == (len(lines), 8), f"{name}: rows of shape {rows.shape}"
                assert np.all(np.diff(rows[:, 0]) > 0), f"{name}: its times do not rise"

    def test_a_calibration_that_it_writes_is_read_again(self) -> None:
        """Within 1e-6 mm and 1e-6 px, if it does both."""
        one = self.format
        if one.write_calibration is None:
            return
        given = Calibration(tuple(example().cameras.values()))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "calibration")
            one.write_calibration(path, given)
            assert path.stat().st_size > 0, "nothing is written"
            if one.read_calibration is None:
                return
            rig = one.read_calibration(path, path.read_text(encoding="utf-8"))
        if rig is None:
            raise CalibrationError("it does not recognise what it writes")
        again = rig.calibration(path, None, {c.name: c.intrinsics.size_wh for c in given.cameras})
        for before, after in zip(given.cameras, again.cameras, strict=True):
            off = before.world_from_camera.difference(after.world_from_camera)
            assert np.abs(off).max() < 1e-6, f"{before.name} stands elsewhere"
            bent = before.intrinsics.matrix - after.intrinsics.matrix
            assert np.abs(bent).max() < 1e-6, f"{before.name} has another lens"
