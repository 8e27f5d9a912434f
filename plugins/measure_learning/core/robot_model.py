"""What cameras see of a robot, as one model that is linear in named blocks near a state.

Every pose is world_from_base @ base_from_flange(joints + rates * delay) @ flange_from_body. The
blocks are `frame` (world_from_base), `tool` (body_from_flange), `delay` (one of every recording),
`links` (errors of the links: one along a joint's axis is that joint's offset) and `scale` (of the
cameras' world).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import RigidTransform, propagate, skew
from measure.metrology.poses import PoseTable, SharedErrors
from measure.robots import SerialChain
from measure_learning.robots.links import link_jacobian, with_link_errors

FRAMES = 12
"""Unknowns of `frame` and `tool`, which stand first."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Poses of all recordings, and what the robot reports at their instants."""

    poses: PoseTable  # n of them
    recording: Ints  # (n,) which of the recordings, from 0 on
    reported_mm: Floats  # (n, 3) the flange
    joints: Floats  # (n, joints) of the chain
    rates: Floats  # (n, joints) their change per second; without a chain (n, 3), of the flange
    chain: SerialChain | None
    shared: tuple[SharedErrors | None, ...]  # of each recording; errors are independent if None
    clocks_known: bool = False
    apart: bool = False  # stops: what is left of one says nothing of that of the next
    turned: bool = True  # rotations were measured; else those of the poses mean nothing

    @classmethod
    def of_points(
        cls,
        measured_mm: Floats,
        reported_mm: Floats,
        joints: Floats,
        chain: SerialChain | None,
        rates: Floats | None = None,
        times_s: Floats | None = None,
    ) -> Sightings:
        """Positions (n, 3) of the same instants in one frame, of one recording."""
        n, still = len(measured_mm), joints if chain else reported_mm
        places = RigidTransform(np.broadcast_to(np.eye(3), (n, 3, 3)), measured_mm)
        return cls(
            PoseTable(np.arange(float(n)) if times_s is None else times_s, places,
                      np.zeros((n, 6, 6))),
            np.zeros(n, dtype=np.int64), reported_mm, joints,
            np.zeros_like(still) if rates is None else rates, chain, (None,),
            clocks_known=rates is None, apart=times_s is None, turned=False,
        )  # fmt: skip

    @property
    def links(self) -> int:
        """Number of links' errors."""
        return 6 * self.chain.size if self.chain else 0

    @property
    def places_mm(self) -> Floats:
        """Where the cameras see the body, (n, 3)."""
        return self.poses.world_from_body.translation

    def take(self, rows: Ints | Bools | slice) -> Sightings:
        """Some of them."""
        by_row = ("recording", "reported_mm", "joints", "rates")
        taken = {name: getattr(self, name)[rows] for name in by_row}
        return replace(self, poses=self.poses.take(rows), **taken)

    def hand(self) -> RigidTransform:
        """base_from_flange (n) as reported; without a chain it does not turn."""
        turns = np.eye(3) if self.chain is None else self.chain.pose(self.joints).rotation
        return RigidTransform(turns, self.reported_mm)

    def flange(self, links: Floats, clocks_s: Floats) -> tuple[RigidTransform, Floats, Floats]:
        """base_from_flange (n), and its change by a second (n, 6) and by the links (n, 6, links).

        Without a chain it does not turn.
        """
        late = clocks_s[self.recording, None] * self.rates
        if self.chain is None:
            twist = np.concatenate([self.rates, np.zeros_like(self.rates)], axis=1)
            moved = RigidTransform(np.eye(3), self.reported_mm + late)
            return moved, twist, np.zeros((len(late), 6, 0))
        bent, q = with_link_errors(self.chain, links), self.joints + late
        pose = bent.pose(q)
        place = pose.translation + self.reported_mm - self.chain.tip_mm(self.joints)
        twist = np.einsum("nij,nj->ni", bent.jacobian(q), self.rates)
        return RigidTransform(pose.rotation, place), twist, link_jacobian(bent, q)


@dataclass(frozen=True, eq=False)
class RobotState:
    """Values of the blocks, near which the model is linear."""

    world_from_base: RigidTransform
    body_from_flange: RigidTransform
    clocks_s: Floats  # (recordings,) what is to be added to the offsets of the sightings
    links: Floats  # (links,) errors, mm and rad

    @classmethod
    def nominal(
        cls,
        seen: Sightings,
        base: RigidTransform | None = None,
        flange: RigidTransform | None = None,
    ) -> Self:
        """Frames, which are the identity if not given, with clocks and links as they are."""
        one = RigidTransform.identity()
        return cls(base or one, flange or one, np.zeros(len(seen.shared)), np.zeros(seen.links))

    def moved(self, step: Mapping[str, Floats]) -> Self:
        """With steps of blocks, each of its own size; of `tool` the shift alone may be given."""
        zero = np.zeros(6)
        return replace(
            self,
            world_from_base=self.world_from_base.perturb(step.get("frame", zero)),
            body_from_flange=self.body_from_flange.perturb(
                np.pad(tool := step.get("tool", zero), (0, 6 - len(tool)))
            ),
            clocks_s=self.clocks_s + step.get("delay", 0.0),
            links=self.links + step.get("links", 0.0),
        )


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The model near a state, of n poses with m residuals each."""

    residuals: Floats  # (n, m) measured minus modelled
    blocks: dict[str, Floats]  # of each (n, m, k) slopes of the model
    by_pose: Floats  # (n, m, 6) of the residuals
    covariances: Floats  # (n, m, m) as the poses state

    @classmethod
    def of(cls, state: RobotState, seen: Sightings) -> LinearModel:
        """Linearise: poses, or positions where rotations or the flange's are not known."""
        base, flange = state.world_from_base, state.body_from_flange
        poses = seen.poses.world_from_body
        reported, twist, by_links = seen.flange(state.links, state.clocks_s)
        hand, R, n = base @ reported, base.rotation, len(seen.poses)
        E = np.broadcast_to(np.eye(6), (n, 6, 6)).copy()
        tool = np.zeros((n, 6, 6))
        if seen.chain:
            model = hand @ flange.inverse()
            r = poses.difference(model)
            lever = model.translation - hand.translation
            tool[:, :3, :3] = tool[:, 3:, 3:] = -model.rotation
            tool[:, :3, 3:] = -model.rotation @ skew(flange.translation)
        else:  # the reported point, as the cameras see it
            model, lever = hand, np.zeros((n, 3))
            r = poses.apply(np.broadcast_to(flange.translation, (n, 3))) - hand.translation
            tool[:, :3, :3] = -poses.rotation
            E[:, :3, 3:] = -skew(poses.rotation @ flange.translation)
        if not seen.turned:
            tool, E = tool[:, :, :3], np.eye(6)[None].repeat(n, axis=0)
        by_hand = np.kron(np.eye(2), R)[None].repeat(n, axis=0)
        by_hand[:, :3, 3:] = -skew(lever) @ R
        delay = np.zeros((n, 6, len(seen.shared)))
        delay[np.arange(n), :, seen.recording] = np.einsum("nab,nb->na", by_hand, twist)
        frame = np.eye(6)[None].repeat(n, axis=0)
        frame[:, :3, 3:] = -skew(model.translation - base.translation)
        blocks = {"frame": frame, "tool": tool, "delay": delay, "links": by_hand @ by_links}
        size = 6 if seen.chain and seen.turned else 3
        blocks = {name: block[:, :size] for name, block in blocks.items()}
        E = E[:, :size]
        return cls(r[:, :size], blocks, E, propagate(E, seen.poses.covariances))

    @cached_property
    def slopes(self) -> Floats:
        """Of all blocks (n, m, parameters), one after the other."""
        return np.concatenate(list(self.blocks.values()), axis=2)

    def split(self, step: Floats) -> dict[str, Floats]:
        """A step of all unknowns, or of those of the first blocks, by block."""
        ends = np.cumsum([block.shape[2] for block in self.blocks.values()])
        parts = zip(self.blocks, np.split(step, ends[:-1]), strict=True)
        return {name: part for name, part in parts if len(part)}

    @property
    def white(self) -> Floats:
        """Residuals (n, m) over what the poses state."""
        roots = np.linalg.cholesky(self.covariances)
        return np.asarray(np.linalg.solve(roots, self.residuals[..., None])[..., 0])

    def normal(self, extra: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """S' W (n, p, m), and its sums with slopes S and residuals; W allows for `extra` noise."""
        weighted = np.swapaxes(np.linalg.solve(self.covariances + extra, self.slopes), 1, 2)
        matrix = np.einsum("npm,nmk->pk", weighted, self.slopes, optimize=True)
        return weighted, matrix, np.einsum("npm,nm->p", weighted, self.residuals)
