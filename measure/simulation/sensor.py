"""The sensor chain from linear radiance to an image file.

Order: exposure (motion blur and rolling shutter, in the ray caster), optical blur, gain, Bayer
mosaic, shot and read noise, demosaicing, tone curve, sharpening, level noise, 8 bits, file.
Every stage can be switched off.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.arrays import Bytes, Floats
from measure.errors import ConfigError

Linear = NDArray[np.float32]
_TONE_STEPS = 1 << 16
_CHROMA = {
    "444": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "422": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "420": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}
# Bilinear, as webcams do; Malvar-He-Cutler would be sharper.
_BAYER = cv2.COLOR_BayerBG2BGR


@dataclass(frozen=True)
class CameraSensor:
    """The sensor chain of a camera."""

    exposure_s: float = 0.0  # exposure time, for motion blur; 0 for none
    # rolling shutter: time from row to row (the middle row is on time); 0 for global.
    row_time_s: float = 0.0
    blur_px: float = 0.7  # sigma of the optical blur
    gain: float = 1.0  # from radiance to the sensor's full scale
    bayer: bool = False  # whether colours are sampled through an RGGB mosaic and interpolated
    electrons: float = 0.0  # at full scale, for shot noise; 0 for none
    read_noise: float = 0.0  # in electrons if `electrons`, else in shares of full scale
    # "linear", "srgb", "bent" (a contrast curve on top of sRGB), or a gamma as "2.2".
    tone: str = "srgb"
    sharpen: float = 0.0  # gain of the unsharp mask
    sharpen_px: float = 1.0  # its sigma
    level_noise: float = 0.0  # sigma of noise added to the encoded 8-bit levels
    encoding: Literal["jpg", "png"] = "jpg"
    quality: int = 95  # JPEG quality, 1 to 100
    chroma: Literal["444", "422", "420"] = "444"  # JPEG chroma subsampling, "444", "422" or "420"


def develop(radiance: Linear, sensor: CameraSensor, rng: np.random.Generator) -> Bytes:
    """The 8-bit picture (h, w, 3) of linear radiance (h, w, 3), both B G R."""
    light = radiance
    if sensor.blur_px > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), sensor.blur_px), np.float32)
    light = light * np.float32(sensor.gain)
    light = _mosaic(light, sensor, rng) if sensor.bayer else _noisy(light, sensor, rng)
    levels = tone_curve(sensor.tone)[_indices(light)]
    if sensor.sharpen > 0:
        soft = cv2.GaussianBlur(levels, (0, 0), sensor.sharpen_px)
        levels = levels + np.float32(sensor.sharpen) * (levels - np.asarray(soft, np.float32))
    if sensor.level_noise > 0:
        noise = rng.standard_normal(levels.shape, dtype=np.float32)
        return _mixed(levels, 1.0, noise, sensor.level_noise, cv2.CV_8U)
    return _mixed(levels, 1.0, levels, 0.0, cv2.CV_8U)


@lru_cache
def tone_curve(tone: str) -> Linear:
    """Encoded levels 0-255 of `_TONE_STEPS` linear values 0 to 1; ConfigError: no such curve."""
    x = np.linspace(0, 1, _TONE_STEPS)
    if tone == "linear":
        y = x
    elif tone == "srgb":
        y = _srgb(x)
    elif tone == "bent":
        s = _srgb(x)
        y = s + 0.12 * np.sin(2 * np.pi * (s - 0.5)) * (1 - 0.3 * s)
        y = np.maximum.accumulate(np.clip(y + 0.02, 0, 1))
    else:
        try:
            y = x ** (1 / float(tone))
        except (ValueError, ZeroDivisionError):
            raise ConfigError(
                f"tone '{tone}': expected linear, srgb, bent or a gamma such as 2.2"
            ) from None
    levels = (255 * y).astype(np.float32)
    levels.flags.writeable = False
    return levels


def encode(picture: Bytes, sensor: CameraSensor) -> bytes:
    """The bytes of the image file."""
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        sensor.quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        _CHROMA[sensor.chroma],
    ]
    if sensor.encoding == "png":
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    ok, data = cv2.imencode("." + sensor.encoding, picture, options)
    if not ok:
        raise RuntimeError(f"OpenCV could not encode a {picture.shape} picture")
    return bytes(data)


def _srgb(x: Floats) -> Floats:
    """IEC 61966-2-1."""
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def _indices(light: Linear) -> NDArray[np.uint16]:
    """Linear light as indices into the tone curve."""
    return _mixed(light, float(_TONE_STEPS - 1), light, 0.0, cv2.CV_16U)


def _mixed(a: Linear, gain_a: float, b: Linear, gain_b: float, depth: int) -> NDArray[Any]:
    """`gain_a * a + gain_b * b`, rounded and clipped to an integer type."""
    return np.asarray(cv2.addWeighted(a, gain_a, b, gain_b, 0.0, dtype=depth))


def _noisy(light: Linear, sensor: CameraSensor, rng: np.random.Generator) -> Linear:
    """Add shot and read noise to linear light of any shape."""
    if sensor.electrons > 0:
        sigma = np.maximum(light, 0) * np.float32(1 / sensor.electrons)
        sigma += np.float32((sensor.read_noise / sensor.electrons) ** 2)
        np.sqrt(sigma, out=sigma)
    elif sensor.read_noise > 0:
        sigma = np.full_like(light, sensor.read_noise)
    else:
        return light
    return light + sigma * rng.standard_normal(light.shape, dtype=np.float32)


def _mosaic(light: Linear, sensor: CameraSensor, rng: np.random.Generator) -> Linear:
    """Sample through an RGGB mosaic, add noise, clip, interpolate bilinearly."""
    raw = np.empty(light.shape[:2], np.float32)
    raw[0::2, 0::2] = light[0::2, 0::2, 2]
    raw[0::2, 1::2] = light[0::2, 1::2, 1]
    raw[1::2, 0::2] = light[1::2, 0::2, 1]
    raw[1::2, 1::2] = light[1::2, 1::2, 0]
    raw = np.clip(_noisy(raw, sensor, rng), 0, 1)
    colours = cv2.cvtColor((raw * 65535 + 0.5).astype(np.uint16), _BAYER)
    return (colours * np.float32(1 / 65535)).astype(np.float32)
