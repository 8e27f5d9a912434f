"""What may be off with a rig: hypotheses, each a few of its parameters."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.checking.causes import Word
from measure.checking.evidence import (
    CLOCK,
    FOCAL,
    POINT,
    ROLL,
    SCALE,
    SHIFT,
    SPREAD,
    TURN,
    Evidence,
)
from measure.errors import DegenerateGeometryError
from measure.geometry.transform import align_points
from measure.model import Body

MIDWAY = {Word.CLOCK: Word.CLOCK_STEP, Word.MOVED: Word.MOVED_AT, Word.ZOOM: Word.ZOOM}
"""What something is called that begins midway."""


_IN_LINE_MM = 1e-3
_SLOW_S = 10.0  # Of a recording that may show that a camera drifts
_SHOWS_MM = 0.1  # By which a mistake in the body file moves a ball at least that pictures show
_PERMUTED = 4  # Every order of so many balls is tried; of more, exchanges of two
WHOLE = (Word.EXCHANGED_BALLS, Word.MIRRORED)
"""Mistakes in the body file that hold or do not: their parameter is 1 or 0."""
LARGEST = {Word.ROLLING: 0.1, Word.ZOOM: 0.7, Word.RADIUS: 0.7, Word.SCALE: 1.0, Word.PLACE: 100.0}
"""What no camera, body or board is off by: s of readout, logarithms, mm."""


class Hypothesis(NamedTuple):
    """A few parameters of the rig that may be off."""

    word: Word
    of: str  # the camera or ball; empty for all
    basis: Floats  # (p, q) the rig's parameters by those of the hypothesis
    since: int | None = None  # the first instant for which it holds; None for all
    drifts: bool = False  # the second half of its parameters grow with time, by so much a second
    wanders: bool = False  # equally many parameters are of each instant alone

    def profile(self, times_s: Floats) -> Floats:
        """How much of each of its parameters holds (k, q) at instants (k,)."""
        out = np.ones((len(times_s), self.basis.shape[1]))
        out[: self.since or 0] = 0.0
        if self.wanders:
            count = out.shape[1] // len(times_s)
            out = np.asarray(np.kron(np.eye(len(times_s)), np.ones((1, count))), np.float64)
        if self.drifts:
            out[:, out.shape[1] // 2 :] = (times_s - np.mean(times_s))[:, None]
        return out


def hypotheses(evidence: Evidence) -> Iterator[Hypothesis]:
    """All that hold from the start."""
    size, eye = evidence.size, np.eye(evidence.size)
    cameras, body = evidence.cameras, evidence.body

    def columns(*index: int) -> Floats:
        return eye[:, list(index)]

    def together(what: slice) -> Floats:
        each = [evidence.of_camera(c, what) for c in range(len(cameras))]
        out = np.zeros((size, len(each[0])))
        for own in each:
            out[own, range(len(own))] = 1.0
        return out

    for index, camera in enumerate(cameras):
        yield from of_camera(evidence, index, camera.name)
        clock = columns(*evidence.of_camera(index, CLOCK))
        yield Hypothesis(Word.CLOCK, camera.name, np.hstack([clock, clock]), drifts=True)
        yield Hypothesis(Word.ROLLING, camera.name, columns(*evidence.of_camera(index, ROLL)))
        yield Hypothesis(Word.POINT, camera.name, columns(*evidence.of_camera(index, POINT)))
        if len(cameras) > 2:
            pose = evidence.of_camera(index, SHIFT) + evidence.of_camera(index, TURN)
            yield Hypothesis(Word.MOVED, camera.name, columns(*pose))
            if np.ptp(evidence.times_s) >= _SLOW_S:
                turn = columns(*evidence.of_camera(index, TURN)[:2])
                yield Hypothesis(Word.DRIFT, camera.name, np.hstack([turn, turn]), drifts=True)
    enlarged = np.zeros((size, 1))
    for index, camera in enumerate(cameras):
        own = _enlarged(evidence, index)
        enlarged += own
        yield Hypothesis(Word.ZOOM, camera.name, own)
    yield Hypothesis(Word.ZOOM, "", enlarged)
    yield Hypothesis(Word.ZOOM, "", together(FOCAL))
    yield Hypothesis(Word.POINT, "", together(POINT))
    yield Hypothesis(Word.ROLLING, "", together(ROLL))
    yield Hypothesis(Word.SCALE, "", columns(evidence.shared(SCALE)))
    yield Hypothesis(Word.PLACE, "", columns(evidence.shared(SPREAD)))
    count = len(body.balls)
    every = columns(*(evidence.radius(k) for k in range(count))).sum(axis=1, keepdims=True)
    yield Hypothesis(Word.RADIUS, "", every)
    places = np.ravel([evidence.place(k) for k in range(count)])
    for word, of, centers in _mistaken(body):
        step = np.zeros((size, 1))
        step[places, 0] = np.ravel(centers - body.centers)
        if np.max(np.linalg.norm(centers - body.centers, axis=1)) > _SHOWS_MM:
            yield Hypothesis(word, of, step)
    for index, ball in enumerate(body.balls):
        yield Hypothesis(Word.RADIUS, ball.name, columns(evidence.radius(index)))
        basis = columns(*evidence.place(index)) @ _determined(body, index)
        yield Hypothesis(Word.PLACE, ball.name, basis)


def _mistaken(body: Body) -> Iterator[tuple[Word, str, Floats]]:
    """Bodies that the file may mean: with balls exchanged, or mirrored; each laid onto the file's.

    What is moved stands before the centres (n, 3).
    """
    count = len(body.balls)
    orders = permutations(range(count)) if count <= _PERMUTED else _exchanges(count)
    for order in orders:
        if moved := [name for k, name in enumerate(body.names) if order[k] != k]:
            centers = body.centers[list(order)]
            yield Word.EXCHANGED_BALLS, ", ".join(moved), laid_onto(body.centers, centers)
    yield Word.MIRRORED, "body", laid_onto(body.centers, body.centers * [-1.0, 1.0, 1.0])


def _exchanges(count: int) -> Iterator[tuple[int, ...]]:
    for a, b in combinations(range(count), 2):
        yield tuple({a: b, b: a}.get(k, k) for k in range(count))


def laid_onto(file: Floats, centers: Floats) -> Floats:
    """Centres (n, 3) moved rigidly as near as they come to the file's; those if nothing tells."""
    try:
        return align_points(file, centers).apply(centers)
    except DegenerateGeometryError:
        return file


def _determined(body: Body, ball: int) -> Floats:
    """Directions (3, q) in which a ball's place in the body shows; all three but of three balls.

    A turn about the line through all others, where they lie on one, moves it and changes no length.
    """
    others = np.delete(body.centers, ball, axis=0)
    middle = others.mean(axis=0)
    _, sizes, axes = np.linalg.svd(others - middle)
    if len(sizes) > 1 and sizes[1] > _IN_LINE_MM:
        return np.eye(3)
    aside = np.cross(axes[0], body.centers[ball] - middle)
    return np.asarray(np.linalg.svd(aside[None])[2][1:].T)


def _enlarged(evidence: Evidence, index: int) -> Floats:
    """The column (p, 1) of pictures enlarged about their middle, as another crop or resolution is.

    A lens enlarges about the principal point.
    """
    lens, out = evidence.cameras[index].intrinsics, np.zeros((evidence.size, 1))
    out[evidence.of_camera(index, FOCAL)] = 1.0
    middle = (np.array(lens.size_wh) - 1) / 2
    out[evidence.of_camera(index, POINT), 0] = lens.matrix[:2, 2] - middle
    return out


def wandering(evidence: Evidence, index: int) -> Hypothesis:
    """A camera whose picture lies elsewhere at every instant: stabilised, or loosely fixed."""
    turn = np.eye(evidence.size)[:, evidence.of_camera(index, TURN)[:2]]
    basis = np.tile(turn, len(evidence.times_s))
    return Hypothesis(Word.UNKNOWN, evidence.cameras[index].name, basis, wanders=True)


def of_camera(evidence: Evidence, index: int, name: str) -> Iterator[Hypothesis]:
    """Those of one camera that may begin midway."""
    eye = np.eye(evidence.size)
    yield Hypothesis(Word.CLOCK, name, eye[:, evidence.of_camera(index, CLOCK)])
    yield Hypothesis(Word.MOVED, name, eye[:, evidence.of_camera(index, TURN)[:2]])
    yield Hypothesis(Word.ZOOM, name, eye[:, evidence.of_camera(index, FOCAL)])
