from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.fitting.robust_cone import consensus, refine

RAYS = 36
PHI = 2 * np.pi * np.arange(RAYS) / RAYS
AROUND = np.stack([np.cos(PHI), np.sin(PHI)], axis=1)
TRUTH = np.array([2.0, -1.5, 0.8])
GATE_PX, TRIALS = 1.2, 60


def shifts(share_astray, seed=0):
    """Edges of one outline, some of them anywhere, and which are the outline's own."""
    rng = np.random.default_rng(seed)
    out = AROUND @ TRUTH[:2] + TRUTH[2] + rng.normal(scale=0.1, size=RAYS)
    astray = rng.permutation(RAYS) < share_astray * RAYS
    out[astray] = rng.uniform(-12, 12, astray.sum())
    return out, ~astray


def triples(count):
    """The fixed sequence of triples, drawn as slowly as it can be drawn."""
    state, out = 12345, []
    for _ in range(3 * TRIALS):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        out.append((state >> 33) % count)
    return np.reshape(out, (TRIALS, 3))


@pytest.mark.parametrize("share_astray", [0.0, 0.3, 0.5])
def test_consensus_is_the_triple_that_most_points_agree_with(share_astray):
    at, _ = shifts(share_astray)
    use = np.ones(RAYS)
    use[::7] = 0.0
    rows = np.column_stack([AROUND, np.ones(RAYS)])
    index = np.nonzero(use)[0]
    best, expected = -1.0, np.zeros(3)
    for triple in index[triples(len(index))]:
        if abs(np.linalg.det(rows[triple])) < 1e-3:
            continue
        solution = np.linalg.solve(rows[triple], at[triple])
        off = (at[index] - rows[index] @ solution) / GATE_PX
        score = np.sum(np.maximum(1 - off**2, 0))
        if score > best:
            best, expected = score, solution
    found = consensus(at, AROUND, use, GATE_PX, TRIALS)
    assert found == pytest.approx(expected, abs=1e-9)
    assert found == pytest.approx(TRUTH, abs=0.5)


def test_points_that_all_lie_in_one_place_make_no_consensus():
    use = np.zeros(RAYS)
    use[4] = 1.0
    assert np.array_equal(consensus(shifts(0)[0], AROUND, use, GATE_PX, TRIALS), np.zeros(3))


@pytest.mark.parametrize("share_astray", [0.0, 0.3, 0.5])
def test_the_fit_gives_no_weight_to_what_is_astray(share_astray):
    at, own = shifts(share_astray, seed=1)
    use, sd = np.ones(RAYS), np.full(RAYS, 0.1)
    start = consensus(at, AROUND, use, GATE_PX, TRIALS)
    before = at.copy(), start.copy(), use.copy()
    solution, _, weights, scale = refine(at, AROUND, sd, use, start, 2.5, (0.0, 1e3))
    assert solution == pytest.approx(TRUTH, abs=0.15)
    assert 0.3 <= scale < 2
    far = np.abs(at - AROUND @ TRUTH[:2] - TRUTH[2]) > 2
    assert np.all(weights[far] == 0)
    assert np.mean(weights[own] > 0.1) > 0.75
    assert all(np.array_equal(a, b) for a, b in zip(before, (at, start, use), strict=True))


def test_too_few_edges_make_no_fit():
    use = np.zeros(RAYS)
    use[:3] = 1.0
    at, _ = shifts(0)
    *_, scale = refine(at, AROUND, np.full(RAYS, 0.1), use, np.zeros(3), 2.5, (0.0, 1e3))
    assert np.isinf(scale)
