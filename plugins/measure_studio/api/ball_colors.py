"""The colours by which balls of any object are found: common ones, and those that were clicked."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from measure import api
from measure.arrays import Bytes
from measure.errors import ConfigError
from measure.model import BallColor, Body
from measure.model.body import HUE_PERIOD
from measure.processes import Progress, quiet
from measure.reading import parse_toml, read_text
from measure.session import dump_toml, read_body, write_body

_ALIKE = 0.5  # Share of samples from which on they count as a common colour


@dataclass
class BallColors:
    """Which colours are searched for, and what their balls are called; MeasureError by its file.

    Attributes:
        file: where what was learnt is kept.
        learnt: samples BGR (n, 3) by ball, those of each click.
        left_out: names of common colours that are not searched for.
        names: what balls are called, by the name of their colour, if it is not that.
    """

    file: Path
    learnt: dict[str, list[Bytes]] = field(init=False)
    left_out: set[str] = field(default_factory=set)
    names: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.learnt = {}
        if self.file.is_file():
            for ball in parse_toml(read_text(self.file, ConfigError)).get("balls", []):
                if isinstance(ball["color"], dict) and "samples_bgr" in ball["color"]:
                    samples = np.array(ball["color"]["samples_bgr"], np.uint8)
                    self.learnt[ball["name"]] = [samples]

    @property
    def colors(self) -> dict[str, BallColor]:
        """The colours that were learnt, by ball."""
        samples = {ball: np.concatenate(some) for ball, some in self.learnt.items()}
        return {ball: BallColor.from_samples(some) for ball, some in samples.items()}

    @property
    def without(self) -> set[str]:
        """Common colours that are not searched for: left out, or learnt anew."""
        anew = {_common(np.concatenate(some)) for some in self.learnt.values()}
        return (self.left_out | anew) - {""}

    def learn(self, pixels: Bytes, at: tuple[float, float]) -> str:
        """Learn the colour of the ball that was clicked; gives the ball's name.

        A click on a ball whose colour is learnt already adds to it. ConfigError: nothing there is
        as round as a ball, or it is grey or black.

        Args:
            pixels: a picture BGR (h, w, 3).
            at: where it was clicked, px.
        """
        samples = api.clicked_color(pixels, at)
        shares = {
            ball: float(np.mean(color.matches(samples))) for ball, color in self.colors.items()
        }
        known = max(shares, key=lambda ball: shares[ball], default="")
        if not known or shares[known] < _ALIKE:
            known = _free(_common(samples) or "ball", self.learnt)
        self.learnt.setdefault(known, []).append(samples)
        self.left_out.discard(known)
        self._write()
        return known

    def leave_out(self, name: str) -> None:
        """Search for this colour no more."""
        if self.learnt.pop(name, None) is None:
            self.left_out.add(name)
        self._write()

    def add(self, name: str) -> None:
        """Search for a common colour that was left out again."""
        self.left_out.discard(name)

    def call(self, color: str, name: str) -> None:
        """Call the ball of a colour so; ConfigError where another one is called so."""
        if not (name := name.strip()):
            raise ConfigError("a ball needs a name")
        if any(name == self.name(one) for one in {*self.names, *self.learnt} - {color}):
            raise ConfigError(f"another ball is called {name}")
        self.names[color] = name

    def name(self, color: str) -> str:
        """What the ball of a colour is called."""
        return self.names.get(color, color)

    def bodies(self, radius_mm: float, like: Path | None = None) -> list[Body]:
        """What is searched for in pictures: these colours, or a body with what was learnt of it."""
        colors = self.colors
        if like is None:
            bodies = api.search_bodies(radius_mm, colors, self.without)
        else:
            body = read_body(like)
            balls = (replace(ball, color=colors.get(ball.name, ball.color)) for ball in body.balls)
            bodies = [replace(body, balls=tuple(balls))]
        return [self._called(body) for body in bodies]

    def find(
        self,
        session: Path,
        registry: api.Registry,
        radius_mm: float,
        like: Path | None = None,
        progress: Progress = quiet,
    ) -> api.FoundBody:
        """`measure.api.find_body` with these colours; its balls go by them, see `named`."""
        if like is not None and self.learnt:
            write_body(self.file, read_body(like), self._samples())
            like = self.file
        return api.find_body(
            session,
            registry,
            api.BodySearch(radius_mm, like),
            progress,
            learnt=self.colors,
            without=self.without,
        )

    def named(self, found: api.FoundBody) -> api.FoundBody:
        """The same with the balls called as they are called here; ConfigError: two by one name."""
        return replace(
            found,
            body=self._called(found.body),
            distances={
                (self.name(a), self.name(b)): far for (a, b), far in found.distances.items()
            },
            seen_radii={self.name(ball): size for ball, size in found.seen_radii.items()},
            frame=re.sub(r"[^ ,]+", lambda word: self.name(word[0]), found.frame),
        )

    def rgb(self, color: str) -> tuple[int, int, int]:
        """A colour to be shown, 0 to 255: the middle of the samples, or of the common range."""
        if color in self.learnt:
            blue, green, red = np.median(np.concatenate(self.learnt[color]), axis=0).astype(int)
            return int(red), int(green), int(blue)
        known = [ball for body in api.search_bodies(1.0) for ball in body.balls]
        at = next((ball.color.ranges[0] for ball in known if ball.name == color), None)
        if at is None:
            return 128, 128, 128
        last = at.high[0] + HUE_PERIOD * (at.high[0] < at.low[0])
        vivid = 0 if at.low[1] == 0 else 210
        hsv = np.array([[[(at.low[0] + last) // 2 % HUE_PERIOD, vivid, 225]]], np.uint8)
        red, green, blue = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
        return red, green, blue

    def _called(self, body: Body) -> Body:
        """The body with its balls called as they are called here."""
        names = [self.name(name) for name in body.names]
        if len({*names}) < len(names):
            raise ConfigError(f"two balls have one name among {', '.join(names)}")
        balls = zip(body.balls, names, strict=True)
        return replace(body, balls=tuple(replace(ball, name=name) for ball, name in balls))

    def _samples(self) -> Mapping[str, Bytes]:
        return {ball: np.concatenate(some) for ball, some in self.learnt.items()}

    def _write(self) -> None:
        balls: Sequence[Mapping[str, object]] = [
            {"name": ball, "color": {"samples_bgr": some.tolist()}}
            for ball, some in self._samples().items()
        ]
        if balls:
            self.file.write_text(dump_toml({"balls": balls}), "utf-8")
        else:
            self.file.unlink(missing_ok=True)


def _common(samples: Bytes) -> str:
    """The common colour that most samples (n, 3) have; empty if none has half of them."""
    shares = {
        ball.name: float(np.mean(ball.color.matches(samples)))
        for body in api.search_bodies(1.0)
        for ball in body.balls
    }
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] >= _ALIKE else ""


def _free(name: str, taken: Mapping[str, object]) -> str:
    """The name, with a number where it is taken."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name} {number}"
    return free
