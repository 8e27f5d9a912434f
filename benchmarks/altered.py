"""Recordings as other cameras would have taken them: their pictures, developed anew.

What a path tracer knows of light stays in them, and the truth is the same; what changes is what a
camera does to light. JPEG has been through them once more than through a camera's own pictures.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.simulation import CameraSensor
from measure.simulation.sensor import encode

Shares = NDArray[np.float32]
"""Picture values (h, w, 3), or the light they stand for, from 0 to 1."""
_CAMERA = CameraSensor(quality=90, chroma="420")
_SEED = 7


def contrast(values: Shares) -> Shares:
    """More contrast than the standard's tone curve has: a mild S."""
    return values - np.float32(0.06) * np.sin(2 * np.pi * values)


def sharpened(values: Shares) -> Shares:
    """A strong S, and an unsharp mask."""
    bent = values - 0.12 * np.sin(2 * np.pi * values) * (1 - 0.3 * values) + 0.02
    bent = np.clip(bent, 0, 1).astype(np.float32)
    return np.asarray(bent + 0.7 * (bent - cv2.GaussianBlur(bent, (0, 0), 1.1)), np.float32)


def overexposed(values: Shares) -> Shares:
    """Nearly twice the light: what is bright is clipped."""
    return _values(1.8 * _light(values))


def dim(values: Shares) -> Shares:
    """A quarter of the light, and noise."""
    noise = np.random.default_rng(_SEED).normal(0, 0.002, values.shape)
    return _values(0.25 * _light(values) + noise.astype(np.float32))


def defocused(values: Shares) -> Shares:
    """Blurred by 1.6 px."""
    return _values(np.asarray(cv2.GaussianBlur(_light(values), (0, 0), 1.6), np.float32))


def lateral(values: Shares) -> Shares:
    """Red magnified and blue reduced, by half a pixel at the corners."""
    height, width = values.shape[:2]
    middle = np.array([width - 1, height - 1]) / 2
    out = values.copy()
    for channel, larger in ((0, -1.0), (2, 1.0)):
        zoom = 1 + larger * 0.5 / np.linalg.norm(middle)
        to_source = np.column_stack([np.eye(2) / zoom, middle * (1 - 1 / zoom)])
        how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        plane = np.ascontiguousarray(values[:, :, channel])
        out[:, :, channel] = cv2.warpAffine(
            plane, to_source, (width, height), flags=how, borderMode=cv2.BORDER_REPLICATE
        )
    return out


def vignetted(values: Shares) -> Shares:
    """Half the light at the corners."""
    height, width = values.shape[:2]
    down, right = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    share = (1 - (down**2 + right**2) / 4).astype(np.float32)
    return _values(_light(values) * share[:, :, None])


def smoothed(values: Shares) -> Shares:
    """A median filter against noise."""
    return np.asarray(cv2.medianBlur(values, 3), np.float32)


ALTERATIONS: dict[str, Callable[[Shares], Shares]] = {
    one.__name__: one
    for one in (contrast, sharpened, overexposed, dim, defocused, lateral, vignetted, smoothed)
}


RESIZED = {"resized": (1.01, 1.01, 1.01), "mixed": (1.005, 0.995, 1.005)}
"""Factors of the radii in body files that say them wrongly, a ball each."""


def altered_copy(recording: Path, target: Path, alteration: str) -> None:
    """Copy a recording with its JPEG pictures or its body file altered, unless it is there."""
    if target.exists():
        return
    half_done = target.with_name(target.name + ".part")
    shutil.rmtree(half_done, ignore_errors=True)
    shutil.copytree(recording, half_done)
    if alteration in RESIZED:
        file, factors = half_done / "body.toml", iter(RESIZED[alteration])
        text = re.sub(
            r"(?<=radius_mm = )[\d.]+",
            lambda radius: f"{float(radius[0]) * next(factors)}",
            file.read_text(),
        )
        file.chmod(0o644)
        file.write_text(text)
        half_done.rename(target)
        return
    for file in sorted(half_done.rglob("*.jpg")):
        values = np.float32(1 / 255) * np.asarray(cv2.imread(str(file)), np.float32)
        levels = np.rint(255 * np.clip(ALTERATIONS[alteration](values), 0, 1)).astype(np.uint8)
        file.write_bytes(encode(levels, _CAMERA))
    half_done.rename(target)


def _light(values: Shares) -> Shares:
    """Linear light of sRGB values (IEC 61966-2-1)."""
    steep = ((values + 0.055) / 1.055) ** 2.4
    return np.where(values <= 0.04045, values / 12.92, steep).astype(np.float32)


def _values(light: Shares) -> Shares:
    """Picture values of linear light by the same standard."""
    light = np.clip(light, 0, 1)
    steep = 1.055 * light ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, steep).astype(np.float32)
