"""Joining data sets of one robot, and splitting them by trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from measure.errors import EstimatorError
from measure.host import Dataset
from measure.host.dataset import Turns, recording_of
from measure_learning.onnx import OnnxModel

_MIN_RECORDINGS = 3  # from which on whole recordings are kept for validation and test


@dataclass(frozen=True, eq=False)
class Split:
    """Three parts that share no trajectory; validation stands for a test where there is none."""

    train: Dataset
    validation: Dataset
    test: Dataset

    @property
    def scored_on(self) -> str:
        """What the part that scores is."""
        return "validation" if self.test is self.validation else "test"


def split_by_trajectory(
    data: Dataset, *, test: float | Dataset = 0.1, validation: float = 0.1, seed: int = 0
) -> Split:
    """Choose at random until each part has its share of the usable rows.

    Neighbouring rows of a trajectory are almost the same: a random split puts one of them into
    training and the other into the test, which then measures memory, not prediction. Trajectories
    of one recording share what changes at a restart. So whole recordings are chosen where there are
    three, and whole trajectories else. EstimatorError: fewer than three trajectories with labels,
    or shares that leave nothing.
    """
    shares = [validation] if isinstance(test, Dataset) else [test, validation]
    _check_shares(*([0.1, validation] if isinstance(test, Dataset) else shares))
    counts = {name: int(data.usable[rows].sum()) for name, rows in data.runs()}
    names = [name for name, count in counts.items() if count]
    if len(names) <= len(shares):
        raise EstimatorError(
            f"{len(names)} trajector{'y' if len(names) == 1 else 'ies'} cannot be split into "
            f"training, validation{' and test' if shares[1:] else ''}: record more, or cut long "
            "recordings (--cut-s)"
        )
    order = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    total = sum(counts.values())
    chosen: list[list[str]] = []
    for share in shares:
        units, part = _units(order), list[str]()
        while not part or (units[2:] and sum(counts[n] for n in part) < 0.75 * share * total):
            part += units.pop()
        order = [name for unit in units for name in unit]
        chosen.append(part)
    scored = test if isinstance(test, Dataset) else data.select(chosen[0])
    return Split(data.select(order), data.select(chosen[-1]), scored)


def _units(names: Sequence[str]) -> list[list[str]]:
    """What is chosen as a whole: recordings where there are three, else single trajectories."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(recording_of(name), []).append(name)
    return list(found.values()) if len(found) >= _MIN_RECORDINGS else [[name] for name in names]


def split_as_trained(data: Dataset, model: OnnxModel) -> Split:
    """The split a model was trained with, by its card; EstimatorError if the data are others."""
    parts, known = [], model.card.get("data", {})
    for what in ("training", "validation", "test"):
        facts = known.get(what, known.get("validation", {"trajectories": (), "rows": None}))
        part = data.select([name for name in data.names if name in facts["trajectories"]])
        if len(part) != facts["rows"]:
            raise EstimatorError(
                f"{model.where}: the {what} trajectories that its card names are not in these "
                "data, or cut otherwise: give all data sets it was trained on, or a --split-seed "
                "to split these anew"
            )
        parts.append(part)
    return Split(*parts)


def _check_shares(test: float, validation: float) -> None:
    if not (test > 0 and validation > 0 and test + validation < 1):
        raise EstimatorError(
            f"a test share of {test:g} and a validation share of {validation:g}: expected two "
            "above 0 that leave something to train on"
        )


def join(parts: Sequence[Dataset]) -> Dataset:
    """One data set of several of one robot with different trajectories; else EstimatorError."""
    same_robot(parts)
    names = tuple(name for part in parts for name in part.names)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise EstimatorError(f"two recordings are called '{twice}': rename one")
    shifts = np.cumsum([0, *(len(part.names) for part in parts[:-1])])
    joined = Dataset(
        parts[0].schema,
        np.concatenate([part.states for part in parts]),
        np.concatenate([part.times_s for part in parts]),
        np.concatenate([part.trajectory + s for part, s in zip(parts, shifts, strict=True)]),
        names,
        np.concatenate([part.errors_mm for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.usable for part in parts]),
    )
    if all(part.turns is None for part in parts):
        return joined
    each = [part.turns or Turns.unknown(len(part)) for part in parts]
    vectors, spreads = (np.concatenate([getattr(t, f.name) for t in each]) for f in fields(Turns))
    return replace(joined, turns=Turns(vectors, spreads))


def same_robot(parts: Sequence[Dataset]) -> None:
    """Refuse to use data of several robots, or with other features, together (EstimatorError)."""
    robots = {part.schema.robot for part in parts}
    if len(robots) > 1:
        raise EstimatorError(
            f"data of several robots cannot be used together: {', '.join(sorted(robots))}"
        )
    if not all(part.schema.means(parts[0].schema) for part in parts):
        raise EstimatorError(
            f"data of robot '{parts[0].schema.robot}' with other features, units or kinematics "
            "cannot be used together: make all of them with one description of the robot"
        )
