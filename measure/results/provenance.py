"""Where a run comes from: enough to repeat it, and to decide whether it may be resumed."""

from __future__ import annotations

import hashlib
import platform
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError, field_validator

from measure.checking.finding import Finding, Level
from measure.errors import RunError
from measure.host.settings import explain_validation
from measure.reading import parse_toml, read_toml_text
from measure.results.journal import MEND
from measure.results.rig_changes import ChangeTable

_LIBRARIES = ("triball", "numpy", "scipy", "opencv-python-headless", "numba", "av")


@dataclass(frozen=True)
class Provenance:
    """What a run is made from."""

    session: str  # absolute path of the file that describes it
    # SHA-256 of its description, clocks and the names and sizes of its pictures.
    session_digest: str
    calibration: str  # path of the calibration used
    calibration_digest: str  # SHA-256 of that file
    body_digest: str  # SHA-256 of the body as used
    profile: Mapping[str, Any]  # the resolved stages with all their settings, defaults included
    plugins: Mapping[str, str]  # by stage, "NAME of DISTRIBUTION VERSION"
    # what the session left to be known: missing pictures and the like, and what is wrong with it.
    notes: tuple[Finding, ...] = ()
    session_name: str = ""  # what the session is called; empty if not known
    scale_sd: float = 0.0  # of the world: see `Calibration`; the poses' covariances are without it
    keep: str = ""  # what was asked for of cameras that are moved; empty if nothing

    @classmethod
    def of(cls, written: Mapping[str, Any]) -> Provenance:
        """What an earlier run was made from, by the values of its `run.toml`."""
        of_session, of_rig, of_body = (
            written.get(name, {}) for name in ("session", "calibration", "body")
        )
        return cls(
            session=of_session.get("path", ""),
            session_digest=of_session.get("sha256", ""),
            calibration=of_rig.get("path", ""),
            calibration_digest=of_rig.get("sha256", ""),
            body_digest=of_body.get("sha256", ""),
            profile=written.get("profile", {}),
            plugins=written.get("plugins", {}),
            notes=(
                *(
                    Finding(Level.NOTE, "frames", text, code="opened")
                    for text in of_session.get("notes", ())
                ),
                *_RunSessionTable(findings=of_session.get("findings", [])).findings,
            ),
            session_name=of_session.get("name", ""),
            scale_sd=of_rig.get("scale_sd", 0.0),
            keep=of_rig.get("keep", ""),
        )

    def values(self) -> dict[str, Any]:
        """As written to `run.toml`."""
        return {
            "run": {"started": datetime.now(UTC).isoformat(timespec="seconds")},
            "session": {
                "name": self.session_name,
                "path": self.session,
                "sha256": self.session_digest,
                "notes": [one.text for one in self.notes if one.level is Level.NOTE],
                "findings": [asdict(one) for one in self.notes if one.level is not Level.NOTE],
            },
            "calibration": {
                "path": self.calibration,
                "sha256": self.calibration_digest,
                "scale_sd": self.scale_sd,
                "keep": self.keep or None,
            },
            "body": {"sha256": self.body_digest},
            "profile": self.profile,
            "plugins": dict(self.plugins),
            "versions": versions(),
        }

    def differences(self, written: Mapping[str, Any]) -> list[str]:
        """What differs between this and the values of an earlier run's `run.toml`, in words."""
        ours = self.values()
        changed = [
            name
            for name in ("session", "calibration", "body")
            if ours[name]["sha256"] != written.get(name, {}).get("sha256")
        ]
        kept = written.get("calibration", {}).get("keep", "")
        if kept != self.keep:
            changed.append(
                f"--keep-calibration ({kept or 'unset'} then, {self.keep or 'unset'} now)"
            )
        for part in ("profile", "plugins"):
            now, then = flat(ours[part], part), flat(written.get(part, {}), part)
            changed += [
                f"{key} ({then.get(key, 'unset')} then, {now.get(key, 'unset')} now)"
                for key in sorted({*now, *then})
                if now.get(key) != then.get(key)
            ]
        return changed


def read_provenance(file: Path) -> dict[str, Any]:
    """The values of a run's `run.toml`; RunError: it is torn, or holds what no run writes."""
    try:
        values = parse_toml(read_toml_text(file, RunError))
        _RunFile.model_validate(values)
    except tomllib.TOMLDecodeError as error:
        raise RunError(f"{file}: cannot be read ({error}): {MEND}") from error
    except ValidationError as error:
        raise RunError(f"{file}: {explain_validation(error, _RunFile)}: {MEND}") from error
    return values


class _RunTable(BaseModel):
    started: str = ""

    @field_validator("started")
    @classmethod
    def _is_a_time(cls, value: str) -> str:
        if value:
            datetime.fromisoformat(value)
        return value


class _RunSessionTable(BaseModel):
    name: str = ""
    path: str = ""
    notes: list[str] = []
    findings: list[Finding] = []


class _CalibrationTable(BaseModel):
    path: str = ""
    scale_sd: float = 0.0
    keep: str = ""


class _RunFile(BaseModel):
    """The parts of a `run.toml` that are read back."""

    run: _RunTable = _RunTable()
    session: _RunSessionTable = _RunSessionTable()
    calibration: _CalibrationTable = _CalibrationTable()
    body: dict[str, Any] = {}
    profile: dict[str, Any] = {}
    plugins: dict[str, Any] = {}
    versions: dict[str, Any] = {}
    camera_changes: list[ChangeTable] = []


def flat(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Nested values by dotted name, as TOML gives them back: no None, no tuples."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            out |= flat(value, f"{name}.{key}")
        elif value is not None:
            out[f"{name}.{key}"] = list(value) if isinstance(value, tuple) else value
    return out


def versions() -> dict[str, str]:
    """Versions of the program, of Python and of the libraries a result depends on."""
    return {"python": platform.python_version()} | {
        name: metadata.version(name) for name in _LIBRARIES
    }


def digest(parts: Iterable[bytes]) -> str:
    """SHA-256 of byte strings, hexadecimal; their boundaries count."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(len(part).to_bytes(8, "big"))
        sha.update(part)
    return sha.hexdigest()
