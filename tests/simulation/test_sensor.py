"""Each stage of the sensor does what it says, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.simulation import Actor, CameraSensor, Renderer, Sines
from measure.simulation.sensor import develop, encode
from tests.simulation.test_renderer import white_scene

BARE = CameraSensor(blur_px=0.0, tone="linear")


def run(light, seed: int = 0, **changes) -> np.ndarray:
    sensor = replace(BARE, **changes)
    rng = np.random.default_rng(seed)
    return develop(np.asarray(light, np.float32), sensor, rng).astype(float)


def flat(level: float, size: int = 200) -> np.ndarray:
    return np.full((size, size, 3), level, np.float32)


def test_bare_sensor_only_rounds_and_clips() -> None:
    ramp = np.linspace(-0.1, 1.2, 500, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    assert np.abs(run(ramp) - np.clip(255 * ramp, 0, 255)).max() <= 0.51


def test_blur_has_the_stated_width() -> None:
    edge = flat(0.0)
    edge[:, 100:] = 1.0
    spread = np.diff(run(edge, blur_px=1.5)[100, :, 0]) / 255
    x = np.arange(len(spread)) - 99.0
    assert np.sum(spread * x) == pytest.approx(0, abs=0.05)
    assert np.sqrt(np.sum(spread * x**2)) == pytest.approx(1.5, rel=0.05)


def test_shot_noise_grows_with_the_root_of_light() -> None:
    for level in (0.1, 0.4):
        sd = run(flat(level), electrons=2000.0).std()
        assert sd == pytest.approx(255 * np.sqrt(level / 2000), rel=0.05)


def test_mosaic_keeps_flat_colours_and_places() -> None:
    colour = flat(0.0)
    colour[:] = (0.2, 0.4, 0.6)
    assert np.abs(run(colour, bayer=True)[5:-5, 5:-5] - [51, 102, 153]).max() <= 1
    spot = flat(0.0)
    rows, columns = np.mgrid[:200, :200]
    spot += np.exp(-((rows - 90.3) ** 2 + (columns - 110.8) ** 2) / (2 * 4.0**2))[..., None]
    seen = run(spot, bayer=True)
    for channel in range(3):
        weights = seen[..., channel]
        centre = np.sum(weights * rows) / weights.sum(), np.sum(weights * columns) / weights.sum()
        assert centre == pytest.approx((90.3, 110.8), abs=0.05)


def test_unknown_tone_is_refused() -> None:
    with pytest.raises(ConfigError, match="gamma such as"):
        run(flat(0.2), tone="film")


def test_sharpening_overshoots_at_edges_only() -> None:
    edge = flat(0.2)
    edge[:, 100:] = 0.8
    seen = run(edge, blur_px=0.6, sharpen=1.0)[100, :, 0]
    assert seen.max() > 0.8 * 255 + 8
    assert seen.min() < 0.2 * 255 - 8
    assert np.abs(seen[:90] - 0.2 * 255).max() <= 1


def test_files_have_the_stated_encoding() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)
    png = encode(picture, replace(BARE, encoding="png"))
    assert np.array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), picture)
    for chroma, factors in (("444", 0x11), ("422", 0x21), ("420", 0x22)):
        data = encode(picture, replace(BARE, chroma=chroma))
        start = data.index(b"\xff\xc0")  # frame header: the luminance's sampling factors
        assert data[start + 11] == factors
    sizes = [len(encode(picture, replace(BARE, quality=q))) for q in (50, 75, 95)]
    assert sizes == sorted(sizes)


def moving_scene(speed_mm_s: float, **sensor):
    """A ball that moves sideways in the picture at a steady pace at time 0."""
    scene = white_scene(sensor=CameraSensor(blur_px=0.0, **sensor))
    across = scene.cameras[0].world_from_camera.rotation[:, 0]
    amplitude = speed_mm_s / (2 * np.pi * 0.05)
    sines = Sines(
        RigidTransform(np.eye(3), np.zeros(3)),
        np.array([[*(amplitude * across), 0, 0, 0]]),
        np.full((1, 6), 0.05),
        np.zeros((1, 6)),
    )
    return replace(scene, fixed=(), actors=(Actor(scene.fixed, sines),))


def edges_of_row(picture: np.ndarray, row: int) -> tuple[float, float]:
    """Middle and summed width of the ball in one row of coverage."""
    line = picture[row, :, 0].astype(float)
    return float(np.sum(line * np.arange(len(line))) / line.sum()), float(line.sum())


def centroid(picture: np.ndarray) -> tuple[float, float]:
    coverage = picture[..., 0].astype(float)
    rows, columns = np.mgrid[:240, :320]
    return np.sum(columns * coverage) / coverage.sum(), np.sum(rows * coverage) / coverage.sum()


def test_motion_blur_smears_about_the_middle_of_the_exposure() -> None:
    sharp = Renderer(moving_scene(100.0), "cam0").radiance(0.0)
    blurred = Renderer(moving_scene(100.0, exposure_s=0.02), "cam0").radiance(0.0)
    assert centroid(blurred) == pytest.approx(centroid(sharp), abs=0.005)
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    # 2 mm at 435 mm and f = 700 px are 3.2 px of smear.
    partial = np.count_nonzero((blurred[120, :, 0] > 0.01) & (blurred[120, :, 0] < 0.99))
    assert 6 <= partial <= 10


def test_rolling_shutter_shears_a_moving_ball() -> None:
    row_time = 1e-4
    still = Renderer(moving_scene(0.0), "cam0").radiance(0.0)
    rolled = Renderer(moving_scene(100.0, row_time_s=row_time), "cam0").radiance(0.0)
    rows = range(100, 141, 10)
    shift = [edges_of_row(rolled, r)[0] - edges_of_row(still, r)[0] for r in rows]
    px_per_s = 100.0 / 435 * 700
    expected = [(r - 119.5) * row_time * px_per_s for r in rows]
    assert shift == pytest.approx(expected, abs=0.04)
