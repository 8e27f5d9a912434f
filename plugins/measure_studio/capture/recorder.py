"""Writing pictures into a session folder as they come."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Self, TextIO

import cv2

from measure.errors import CaptureError
from measure.model import Body, Image
from measure.session import Calibration, check_name, dump_toml, write_body, write_calibration

_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 98)
_OWN_FILES = ("session.toml", "body.toml", "calibration.toml")
NO_CAMERAS = Calibration(())
_FULL_COLOR = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


class Recorder:
    """A session folder that grows; use it in a `with` block.

    Every picture is a file of its own, its stamp a line that is written at once: whatever ends the
    recording, all pictures before that can be measured. JPEGs stay as the camera made them;
    other pictures become JPEGs of high quality.
    """

    def __init__(
        self,
        folder: Path,
        addresses: Mapping[str, str],
        bodies: Sequence[Body] = (),
        calibration: Calibration = NO_CAMERAS,
        reference: str = "",
        controls: Mapping[str, Mapping[str, int | str]] | None = None,
    ) -> None:
        """Make the folder and all that does not grow.

        Args:
            folder: new, or empty.
            bodies: what is measured, if it is known already.
            calibration: of the cameras, if they are calibrated already.
            reference: name of the body that others are measured relative to; empty without one.
            controls: by camera what its controls are set to, where that is known.

        Raises:
            CaptureError: the folder cannot be written, or has a camera's folder; a camera's name
                cannot be a folder's.
        """
        self._folder, self._lock = folder, Lock()
        self._stamps: dict[str, TextIO] = {}
        check_names(list(addresses))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name in addresses:
                (folder / name).mkdir()  # fails for the second of two that record into it at once
            files = _body_files(bodies)
            for name, body in files.items():
                write_body(folder / name, body)
            known = bool(calibration.cameras)
            if known:
                write_calibration(folder / "calibration.toml", calibration)
            about = _session(folder, addresses, list(files), reference, known)
            tables = [_camera_table(name, (controls or {}).get(name)) for name in addresses]
            text = dump_toml({"session": about, "cameras": tables})
            (folder / "session.toml").write_text(text, "utf-8")
            for name in addresses:
                self._stamps[name] = _new_stamps(folder / f"{name}.csv")
        except OSError as problem:
            self.close()
            raise _cannot_write(folder, problem) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; pictures that come later are not written."""
        with self._lock:
            for file in self._stamps.values():
                with suppress(
                    OSError
                ):  # of a full disk, which was reported as the line was written
                    file.close()
            self._stamps.clear()

    def add(self, image: Image) -> None:
        """Write a picture, each camera's in order; CaptureError if it cannot be: others stay."""
        stamps = self._stamps.get(image.camera)
        if stamps is None:
            return
        data = jpeg_of(image)
        picture = self._folder / image.camera / f"{image.frame:06d}.jpg"
        begun = picture.with_suffix(".part")
        try:
            begun.write_bytes(data)
            # A stamp without a picture counts as a missing frame; pictures without a stamp, or half
            # of one, could not be used.
            stamps.write(f"{image.frame},{image.time_s:.9f}\n")
            begun.rename(picture)
        except OSError as problem:
            raise _cannot_write(self._folder, problem) from None
        except ValueError:
            begun.unlink()  # closed meanwhile


def check_names(names: Sequence[str]) -> None:
    """Refuse (CaptureError) cameras that `check_name` refuses, or alike but for capitals."""
    for name in names:
        try:
            check_name(name)
        except ValueError as problem:
            raise CaptureError(f"a camera's name: {problem}") from None
    places = [*_OWN_FILES, *names, *(f"{name}.csv" for name in names)]
    often = Counter(place.casefold() for place in places)
    for name in names:
        if often[name.casefold()] > 1 or often[f"{name}.csv".casefold()] > 1:
            raise CaptureError(
                f"camera '{name}': another camera, or a file of the session, is called so, apart "
                "from capitals: give it another name"
            )


def _new_stamps(path: Path) -> TextIO:
    file = path.open("w", encoding="utf-8", buffering=1)
    file.write("frame,time_s\n")
    return file


def _body_files(bodies: Sequence[Body]) -> dict[str, Body]:
    if len(bodies) == 1:
        return {"body.toml": bodies[0]}
    return {f"body-{body.name}.toml": body for body in bodies}


def _session(
    folder: Path,
    addresses: Mapping[str, str],
    bodies: Sequence[str],
    reference: str,
    calibrated: bool,
) -> dict[str, object]:
    """The `[session]` table."""
    sources = ", ".join(f"{name}: {address}" for name, address in addresses.items())
    return {
        "name": folder.resolve().name,
        "description": f"recorded from {sources}",
        "body": bodies[0] if len(bodies) == 1 else None,
        "bodies": bodies if len(bodies) > 1 else None,
        "reference": reference or None,
        "calibration": "calibration.toml" if calibrated else None,
    }


def _camera_table(name: str, controls: Mapping[str, int | str] | None) -> dict[str, object]:
    """A camera's `[[cameras]]` table."""
    files = {"images": f"{glob.escape(name)}/*.jpg", "timestamps": f"{name}.csv"}
    return {"name": name, **files, "controls": controls}


def jpeg_of(image: Image) -> bytes:
    """A picture as the JPEG that its camera made, or as one of high quality."""
    if image.encoded is not None:
        return image.encoded
    done, data = cv2.imencode(".jpg", image.pixels, [*_QUALITY, *_FULL_COLOR])
    if not done:
        raise CaptureError(f"camera '{image.camera}': a picture cannot be written as JPEG")
    return bytes(data)


def _cannot_write(folder: Path, problem: OSError) -> CaptureError:
    recorded = any(folder.glob("*/*.jpg")) if folder.is_dir() else False
    stays = "; what was recorded before stays" if recorded else "; nothing was recorded"
    where = problem.filename or folder
    return CaptureError(f"{where}: cannot be written: {problem.strerror}{stays}")
