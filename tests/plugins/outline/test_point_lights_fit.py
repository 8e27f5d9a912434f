"""Powers of point lights: normal equations, non-negative unknowns, several cameras."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import nnls

from measure.processes import usable_cores
from measure_plugins._outline.self_calibration.point_lights import (
    LightEquations,
    add_normal,
    equations,
    non_negative,
    solve_point_lights,
)


def test_normal_equations_are_weighted_sums_over_pixels():
    """Half of the shares are nothing: lamps below a pixel's horizon."""
    rng = np.random.default_rng(0)
    shares = rng.random((203, 30)) * (rng.random((203, 30)) > 0.5)
    weights, amounts = rng.random(203), rng.random(203)
    normal, right = np.zeros((30, 30)), np.zeros(30)
    add_normal(shares, weights, amounts, normal, right)
    assert normal == pytest.approx(np.tril(shares.T * weights @ shares))
    assert right == pytest.approx(shares.T * weights @ amounts)


@pytest.mark.parametrize("seed", range(4))
def test_non_negative_unknowns_are_those_of_lawson_and_hanson(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(40, 8)), rng.normal(size=40)
    found = non_negative(a.T @ a, a.T @ b, np.zeros(8), 500)
    assert found == pytest.approx(nnls(a, b)[0], abs=1e-6)
    assert np.any(found == 0)


def test_cameras_together_find_lights_that_none_sees_all_of():
    """The second is exposed for half as long, and sees lamps from the second on only."""
    rng, true = np.random.default_rng(0), np.array([1.0, 0, 0.5, 2.0, 0, 1.5, 0, 0.2, *[0.1] * 6])
    places = rng.uniform(1, 2, (8, 4))
    seen_by = (slice(0, 6), slice(1, 8))
    lights = []
    for exposure, point_lights in zip((1.0, 0.5), seen_by, strict=True):
        shares = rng.random((400, 14))
        hidden = np.setdiff1d(np.arange(8), np.arange(8)[point_lights])
        shares[:, hidden] = 0.0
        noise = 1e-4 * rng.normal(size=400)
        lights.append(
            LightEquations(places, *equations([shares], [exposure * shares @ true + noise]))
        )
    for light, point_lights in zip(lights, seen_by, strict=True):
        assert len(solve_point_lights([light])) == np.count_nonzero(true[:8][point_lights])
    found = solve_point_lights(lights)
    assert found[:, :3] == pytest.approx(places[true[:8] > 0, :3])
    power = found[:, 3] / places[true[:8] > 0, 3]
    assert power / power.sum() == pytest.approx(true[:8][true[:8] > 0] / 5.2, abs=0.01)


@pytest.mark.skipif(usable_cores() < 2, reason="one core: no library has threads to share work")
def test_point_lights_are_solved_in_the_calling_thread():
    """Threads of the linear algebra library wait for each other where cameras run side by side."""
    script = (
        "import sys, time\n"
        "import numpy as np\n"
        "from measure_plugins._outline.self_calibration import point_lights\n"
        "equations, solve = point_lights.equations, point_lights.solve_point_lights\n"
        "rng = np.random.default_rng(0)\n"
        "shares, seen = [rng.random((600, 100)) for _ in range(6)], [np.ones(600)] * 6\n"
        "places, record = np.ones((94, 4)), point_lights.LightEquations\n"
        "work = {\n"
        "    'lamps': lambda: solve([record(places, *equations(shares, seen))] * 4),\n"
        "    'control': lambda: [one.T @ one for one in shares for _ in range(20)],\n"
        "}[sys.argv[1]]\n"
        "work()\n"
        "all_threads, own = time.process_time(), time.thread_time()\n"
        "work()\n"
        "own, all_threads = time.thread_time() - own, time.process_time() - all_threads\n"
        "print(all_threads / own)"
    )
    for work, threads in (("lamps", False), ("control", True)):
        ran = subprocess.run(
            [sys.executable, "-c", script, work],
            env={**os.environ, "OPENBLAS_NUM_THREADS": "2"},
            capture_output=True,
            text=True,
            check=True,
        )
        assert (float(ran.stdout) > 1.2) == threads, work
