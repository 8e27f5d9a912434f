"""Asking plugins, and naming the one that fails or answers nonsense.

Answers are looked at once, where they come in, and no closer than costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite

from measure.arrays import Floats
from measure.errors import MeasureError, PluginError
from measure.host import Detector, Plugin, PoseSolver, Triangulator
from measure.host.failures import failure, named
from measure.model import BallPosition, Body, Camera, Detection, Expectation, Image, Motion, Pose


def warm_up(kind: str, plugin: Plugin, part: Callable[[], object] | None = None) -> None:
    """Let a plugin of a kind get ready, or a part of it.

    Raises:
        PluginError: it fails.
    """
    with named(kind, plugin, "warming up"):
        (part or plugin.warm_up)()


def detections(
    detector: Detector, image: Image, expected: Sequence[Expectation], body: Body
) -> list[Detection]:
    """What a detector sees in an image.

    Raises:
        PluginError: it fails, or answers nonsense.
    """
    try:
        found = detector.detect(image, expected)
        _check_kind(found, list)
        for one in found:
            _check_kind(one, Detection)
            _check_numbers(one.center_px, one.covariance_px, 2)
            if one.ball not in body.names or one.camera != image.camera:
                raise _NonsenseError(f"a ball '{one.ball}' in camera '{one.camera}'")
            if not (isfinite(one.radius_px) and isfinite(one.time_s)):
                raise _NonsenseError(f"a radius of {one.radius_px} px at {one.time_s} s")
    except MeasureError:
        raise
    except Exception as error:
        place = f"camera '{image.camera}', frame {image.frame}"
        raise _explained("detector", detector, place, error) from error
    return found


def positions(
    triangulator: Triangulator,
    seen: Sequence[Detection],
    cameras: Mapping[str, Camera],
    body: Body,
    time_s: float,
) -> list[BallPosition]:
    """Where a triangulator locates balls, in the order of the body's.

    Raises:
        PluginError: it fails, or answers nonsense.
    """
    try:
        found = triangulator.triangulate_all(seen, cameras)
        for one in found:
            _check_kind(one, BallPosition)
            _check_numbers(one.center, one.covariance, 3)
        return sorted(found, key=lambda position: body.index(position.ball))
    except MeasureError:
        raise
    except Exception as error:
        raise _explained("triangulator", triangulator, f"at {time_s:.6f} s", error) from error


def pose(
    solver: PoseSolver,
    located: Sequence[BallPosition],
    seen: Sequence[Detection],
    cameras: Mapping[str, Camera],
    time_s: float,
    prior: Motion | None,
) -> Pose | None:
    """Where a solver locates the body.

    Raises:
        PluginError: it fails, or answers nonsense.
    """
    try:
        found = solver.solve(located, seen, cameras, time_s, prior)
        if found is not None:
            _check_kind(found, Pose)
            place = found.world_from_body
            _check_numbers(place.translation, found.covariance, 6)
            if not isfinite(place.rotation.sum()):
                raise _NonsenseError(f"a pose turned by {place.rotation.tolist()}")
    except MeasureError:
        raise
    except Exception as error:
        raise _explained("solver", solver, f"at {time_s:.6f} s", error) from error
    return found


class _NonsenseError(Exception):
    """An answer that is none."""


def _check_kind(answer: object, kind: type) -> None:
    if not isinstance(answer, kind):
        raise _NonsenseError(f"no {kind.__name__} but {answer!r:.60}")


def _check_numbers(place: Floats, covariance: Floats, size: int) -> None:
    if covariance.shape != (size, size) or place.shape != (min(size, 3),):
        raise _NonsenseError(f"arrays of shape {place.shape} and {covariance.shape}")
    if not isfinite(sum(place.tolist(), sum(covariance.ravel().tolist()))):
        raise _NonsenseError(f"{place.tolist()} with the covariance {covariance.tolist()}")


def _explained(kind: str, plugin: Plugin, place: str, error: Exception) -> PluginError:
    """What a plugin did, in one line."""
    if isinstance(error, _NonsenseError):
        return PluginError(f"{kind} '{plugin.name}' answers nonsense ({place}): {error}")
    return failure(kind, plugin, place, error)
