"""Robots described by a small TOML file, a URDF or UR's calibration: what a state means."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, ValidationError, model_validator

from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.reading import FileModel, parse_toml, read_toml_text
from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.schema import Feature, LogFormat, OtherNames, Reading, StateSchema
from measure.session import MM_PER
from measure.tables import UNITS_S
from measure_learning.robots.headings import JOINTS, TIPS, UNITS_BEHIND
from measure_learning.robots.other_programs import read_ur_calibration
from measure_learning.robots.urdf import Follows, read_urdf

BUILTIN = Path(__file__).with_name("builtin")
YAML = (".yaml", ".yml")
_FACTORS = {**MM_PER, "um": 1e-3, "rad": 1.0, "deg": np.pi / 180}
_SMALLEST_REACH_MM, _LARGEST_REACH_MM = 5.0, 2e4


class _Column(FileModel):
    name: str
    unit: str = ""


def _not_zero(factor: float) -> float:
    if not 1e-9 <= abs(factor) <= 1e9:
        raise ValueError(f"{factor:g} is no factor between units")
    return factor


_Factor = Annotated[FiniteFloat, AfterValidator(_not_zero)]
_Length = Annotated[FiniteFloat, Field(ge=-1e4, le=1e4)]
_Angle = Annotated[FiniteFloat, Field(ge=-360, le=360)]


class _JointTable(FileModel):
    """A joint and its Denavit-Hartenberg link."""

    feature: str
    scale: _Factor | None = None  # to rad or mm; that of the feature's unit if absent
    kind: Literal["turns", "slides"] = "turns"
    alpha_deg: _Angle | None = None
    a_mm: _Length = 0.0
    offset_deg: _Angle = 0.0
    d_mm: _Length = 0.0


class _Names(FileModel):
    """Columns of a log, for all joints or the three coordinates; {0} and {1} count from there."""

    names: str | list[str]
    scale: _Factor = 1.0


class _LogTable(FileModel):
    joints: list[_Names] = Field(default_factory=list)
    position: list[_Names] = Field(default_factory=list)
    time: str | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    topics: list[str] = Field(default_factory=list)
    tip_topics: list[str] = Field(default_factory=list)
    frames: tuple[str, str] | None = None


class _Robot(FileModel):
    robot: str
    features: list[_Column] = Field(default_factory=list)
    position: Annotated[list[str], Field(min_length=3, max_length=3)] | None = None
    position_to_mm: Annotated[FiniteFloat, Field(ge=1e-9, le=1e9)] | None = None
    joints: list[_JointTable] = Field(default_factory=list)
    dh: Literal["craig", "standard"] = "craig"
    urdf: str | None = None
    calibration: str | None = None  # UR's, whose links replace those of the joints
    base: str | None = None
    tip: str | None = None
    coupled: list[int] = Field(default_factory=list)
    tool_mm: tuple[_Length, _Length, _Length] = (0.0, 0.0, 0.0)
    tool_rotvec_deg: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)
    log: _LogTable = _LogTable()

    @model_validator(mode="after")
    def _fits_together(self) -> _Robot:
        if self.urdf is not None and self.joints:
            raise ValueError("the joints are those of the urdf: leave joints out")
        known = [joint.alpha_deg is not None for joint in self.joints]
        if any(known) and not all(known):
            which = self.joints[known.index(False)].feature
            raise ValueError(f"joint '{which}' has no alpha_deg: give it for all joints, or none")
        for joint in self.joints:
            for angle in (joint.alpha_deg or 0.0, joint.offset_deg):
                quarters = abs(angle) / (np.pi / 2)
                if 0.9 < quarters < 3.1 and abs(quarters - round(quarters)) < 1e-3:
                    raise ValueError(
                        f"joint '{joint.feature}' has an angle of {angle:g} deg, which is a right "
                        "angle in rad: give degrees"
                    )
        return self


def read_schema(path: Path) -> StateSchema:
    """Read a `robot.toml`, a `.urdf` whose joints a log holds by their names, or UR's `.yaml`.

    Joints that carry `alpha_deg` make a kinematic chain, and so does a URDF; otherwise the chain is
    unknown. `like` takes what is not said from a known robot. EstimatorError says where it does not
    fit.
    """
    try:
        file = _Robot.model_validate(_values(path))
        return _schema(path, file)
    except tomllib.TOMLDecodeError as error:
        raise EstimatorError(f"{path}: not TOML: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        place = f"'{where}': " if where else ""
        raise EstimatorError(f"{path}: {place}{first['msg']}") from None


def _values(path: Path) -> dict[str, Any]:
    if path.suffix == ".urdf":
        return {"robot": path.stem, "urdf": path.name}
    if path.suffix in YAML:
        alike = _values(BUILTIN / "ur5e.toml")  # all arms of UR name their joints alike
        return {**alike, "robot": path.stem, "calibration": path.name}
    values = parse_toml(read_toml_text(path, EstimatorError))
    like = values.pop("like", None)
    if like is None:
        return values
    known = BUILTIN / f"{like}.toml"
    if not known.exists():
        names = ", ".join(sorted(one.stem for one in BUILTIN.glob("*.toml")))
        raise EstimatorError(f"{path}: like = {like!r:.40} is no robot; there is {names}")
    base = _values(known)
    if isinstance(log := values.get("log", {}), dict):
        values["log"] = base.get("log", {}) | log
    return base | values


def _schema(path: Path, file: _Robot) -> StateSchema:
    follows, chain = _chain(path, file)
    names = tuple(dict.fromkeys(one.feature for one in follows))
    if chain is None and (file.position is None or not file.features):
        raise EstimatorError(
            f"{path}: name the features and the position, or give the joints' links or a urdf"
        )
    position = tuple(file.position or ("x_mm", "y_mm", "z_mm"))
    features = [Feature(column.name, column.unit) for column in file.features]
    if chain is not None and not file.features:
        units = dict[str, str]()
        for one, joint in zip(follows, chain.joints, strict=True):
            units.setdefault(one.feature, "m" if joint.prismatic else "rad")
        features = [Feature(name, units[name]) for name in names]
    if file.position is None:
        features += [Feature(name, "mm") for name in position]
    units_of = {feature.name: feature.unit for feature in features}
    x, y, z = (
        Reading.of(name, file.position_to_mm or _FACTORS.get(units_of.get(name, ""), 1.0))
        for name in position
    )
    schema = StateSchema(
        robot=file.robot,
        features=tuple(features),
        position=(x, y, z),
        joints=_readings(path, file, follows, chain, units_of),
        coupled=tuple(file.coupled),
        chain=chain,
        groups={key: v for key, v in (("joints", names), ("position", position)) if v},
        log=_log(file, names, position),
    )
    schema.index([*position, *names])
    if wrong := [index for index in file.coupled if not 0 <= index < len(follows)]:
        raise EstimatorError(
            f"{path}: coupled names joint {wrong[0]}; there are {len(follows)}, from 0 on"
        )
    return schema


def _readings(
    path: Path,
    file: _Robot,
    follows: Sequence[Follows],
    chain: SerialChain | None,
    units_of: dict[str, str],
) -> tuple[Reading, ...]:
    """Joints from their features: by the stated scales, else by the features' units."""
    scales = [joint.scale for joint in file.joints] or [None] * len(follows)
    slides = [joint.prismatic for joint in chain.joints] if chain else [None] * len(follows)
    out = []
    for one, scale, sliding in zip(follows, scales, slides, strict=True):
        name = one.feature
        factor = _FACTORS.get(units_of.get(name, ""))
        if scale and factor and not 0.99 < scale / factor < 1.01:
            raise EstimatorError(
                f"{path}: the scale {scale:g} of joint '{name}' is not that of its unit "
                f"{units_of[name]}, {factor:.6g}: leave one of them out"
            )
        own = (
            scale or factor or 1.0
        )  # of the feature's own kind: of a slide to mm, of a turn to rad
        slides_itself = units_of.get(name, "") in ("m", "cm", "mm", "um")
        if sliding is not None and sliding != slides_itself and one.ratio != 1.0:
            own *= 1e3 if sliding else 1e-3
        out.append(Reading.of(name, own * one.ratio))
    return tuple(out)


def _log(file: _Robot, names: tuple[str, ...], position: tuple[str, ...]) -> LogFormat:
    log = file.log
    others = [_named(names, given.names, given.scale) for given in log.joints]
    # Behind the three coordinates a pose goes on: that is no robot of more joints.
    others += [replace(_named(position, p.names, p.scale), unless="") for p in log.position]
    if not file.features:
        for unit, scale in UNITS_BEHIND:
            others += [_named(names, name + unit, scale) for name in JOINTS]
    if file.position is None:
        others += [OtherNames(position, columns, scale) for columns, scale in TIPS]
    return LogFormat(
        names=tuple(others),
        time=log.time,
        time_unit_s=None if log.time_unit is None else UNITS_S[log.time_unit],
        delimiter=log.delimiter,
        topics=tuple(log.topics),
        tip_topics=tuple(log.tip_topics),
        frames=log.frames,
    )


def _named(features: tuple[str, ...], names: str | list[str], scale: float) -> OtherNames:
    if not isinstance(names, str):
        return OtherNames(features, tuple(names), scale)
    *columns, more = (names.format(index, index + 1) for index in range(len(features) + 1))
    return OtherNames(features, tuple(columns), scale, more)


def _chain(path: Path, file: _Robot) -> tuple[tuple[Follows, ...], SerialChain | None]:
    """What the joints follow, and the chain, if it is known."""
    names = tuple(Follows(joint.feature) for joint in file.joints)
    tool = RigidTransform.from_rotvec(np.deg2rad(file.tool_rotvec_deg), file.tool_mm).matrix
    if file.urdf is not None:
        names, chain = read_urdf(path.with_name(file.urdf), file.base, file.tip)
        return names, SerialChain(chain.joints, chain.tool @ tool)
    if not file.joints or file.joints[0].alpha_deg is None:
        return names, None
    if file.calibration is not None:
        chain = read_ur_calibration(path.with_name(file.calibration))
        if chain.size != len(names):
            raise EstimatorError(f"{path}: {file.calibration} is of {chain.size} joints")
        return names, SerialChain(chain.joints, tool)
    # The standard table says of a link what Craig's says before the next joint.
    before = [(np.deg2rad(joint.alpha_deg or 0.0), joint.a_mm) for joint in file.joints]
    if file.dh == "standard":
        tool = dh_link(*before[-1]) @ tool
        before = [(0.0, 0.0), *before[:-1]]
    joints = tuple(
        Joint(
            dh_link(alpha, a, np.deg2rad(j.offset_deg), j.d_mm),
            np.array([0.0, 0.0, 1.0]),
            j.kind == "slides",
        )
        for j, (alpha, a) in zip(file.joints, before, strict=True)
    )
    reach = float(sum(np.linalg.norm(link[:3, 3]) for link in (*(j.link for j in joints), tool)))
    if not _SMALLEST_REACH_MM <= reach <= _LARGEST_REACH_MM:
        raise EstimatorError(
            f"{path}: its links are {reach:g} mm long together, no robot's: are they in mm?"
        )
    return names, SerialChain(joints, tool)
