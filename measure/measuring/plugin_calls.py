"""Calls of plugins: their results are checked, and errors name the plugin.

The checks are those that cost next to nothing: types, shapes and finite numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import isfinite

from measure.arrays import Floats
from measure.errors import MeasureError, PluginError
from measure.host import Detector, Plugin, PoseSolver, Triangulator
from measure.host.registry import failure, named
from measure.model import BallPosition, Body, Camera, Detection, Expectation, Image, Motion, Pose


def warm_up(kind: str, plugin: Plugin, order: int) -> None:
    """Let a plugin compile what is slow, part by part in order 1 or -1; PluginError if it fails."""
    with named(kind, plugin, "warming up"):
        for part in plugin.warm_up_parts()[::order]:
            part()


def detections(
    detector: Detector, image: Image, expected: Sequence[Expectation], body: Body
) -> list[Detection]:
    """What a detector finds in an image; PluginError if it fails, or its result is invalid."""
    with _checked("detector", detector, f"camera '{image.camera}', frame {image.frame}"):
        found = detector.detect(image, expected)
        _check_type(found, list)
        for one in found:
            _check_type(one, Detection)
            _check_numbers(one.center_px, one.covariance_px, 2)
            if one.ball not in body.names or one.camera != image.camera:
                raise _InvalidResultError(f"a ball '{one.ball}' in camera '{one.camera}'")
            if not (isfinite(one.radius_px) and isfinite(one.time_s)):
                raise _InvalidResultError(f"a radius of {one.radius_px} px at {one.time_s} s")
    return found


def positions(
    triangulator: Triangulator,
    seen: Sequence[Detection],
    cameras: Mapping[str, Camera],
    body: Body,
    time_s: float,
) -> list[BallPosition]:
    """Positions by a triangulator, in the order of the body's balls; PluginError if it fails."""
    with _checked("triangulator", triangulator, f"at {time_s:.6f} s"):
        found = triangulator.triangulate_all(seen, cameras)
        for one in found:
            _check_type(one, BallPosition)
            _check_numbers(one.center, one.covariance, 3)
        return sorted(found, key=lambda position: body.index(position.ball))


def pose(
    solver: PoseSolver,
    located: Sequence[BallPosition],
    seen: Sequence[Detection],
    cameras: Mapping[str, Camera],
    time_s: float,
    prior: Motion | None,
) -> Pose | None:
    """The body's pose by a solver; None if it finds none; PluginError if it fails."""
    with _checked("solver", solver, f"at {time_s:.6f} s"):
        found = solver.solve(located, seen, cameras, time_s, prior)
        if found is not None:
            _check_type(found, Pose)
            place = found.world_from_body
            _check_numbers(place.translation, found.covariance, 6)
            if not isfinite(place.rotation.sum()):
                raise _InvalidResultError(f"a pose turned by {place.rotation.tolist()}")
    return found


@contextmanager
def _checked(kind: str, plugin: Plugin, place: str) -> Iterator[None]:
    """Name the plugin in whatever but a `MeasureError` its call or the check of it raises."""
    try:
        yield
    except MeasureError:
        raise
    except _InvalidResultError as error:
        nonsense = f"{kind} '{plugin.name}' answers nonsense ({place}): {error}"
        raise PluginError(nonsense) from error
    except Exception as error:
        raise failure(kind, plugin, place, error) from error


class _InvalidResultError(Exception):
    """A plugin returned something of the wrong type or shape, or not finite."""


def _check_type(result: object, kind: type) -> None:
    if not isinstance(result, kind):
        raise _InvalidResultError(f"no {kind.__name__} but {result!r:.60}")


def _check_numbers(place: Floats, covariance: Floats, size: int) -> None:
    if covariance.shape != (size, size) or place.shape != (min(size, 3),):
        raise _InvalidResultError(f"arrays of shape {place.shape} and {covariance.shape}")
    if not isfinite(sum(place.tolist(), sum(covariance.ravel().tolist()))):
        raise _InvalidResultError(f"{place.tolist()} with the covariance {covariance.tolist()}")
