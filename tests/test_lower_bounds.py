"""Lower bounds of distances in float32: no pair within reach is ruled out, and few others are left."""

import numpy as np
import pytest

from clothgym.collisions.self.lower_bounds import keep_edges, keep_vertices, round_positions

PAIRS = 256


def sampled_distances(one, other, points=21):
    """Distances of pairs of primitives, (pairs, 2 or 1 or 3 vertices, 3) each, from points on both: no less than the true ones."""

    def on(corners):
        share = np.linspace(0, 1, points)
        if corners.shape[1] == 1:
            return corners
        if corners.shape[1] == 2:
            weights = np.stack([1 - share, share], axis=1)
        else:
            a, b = np.meshgrid(share, share, indexing="ij")
            inside = a + b <= 1 + 1e-12
            weights = np.stack([1 - a - b, a, b], axis=2)[inside]
        return np.einsum("wc,pcx->pwx", weights, corners)

    gaps = on(one)[:, :, None] - on(other)[:, None]
    return np.sqrt((gaps**2).sum(axis=-1)).min(axis=(1, 2))


def pairs_at(kind, shape, scale, origin, rng):
    """Pairs of edges, or of vertices and triangles, at distances of about ``scale``, far from each other along x."""
    sizes = (2, 2) if kind == "edges" else (1, 3)
    one, other = (rng.normal(0, scale, (PAIRS, size, 3)) for size in sizes)
    if shape == "slivers":
        other[:, -1] = other[:, 0] + 1e-4 * (other[:, -1] - other[:, 0])
    elif shape == "parallel" and kind == "edges":
        other = one + rng.normal(0, scale, (PAIRS, 1, 3)) * np.ones((1, 2, 1))
    elif shape == "points":
        other[:] = other[:, :1]
    place = origin + np.stack([np.linspace(0, 3, PAIRS), np.zeros(PAIRS), np.zeros(PAIRS)], axis=1)
    return one + place[:, None], other + place[:, None]


@pytest.mark.parametrize("origin", [0.0, 15.0, 3000.0])
@pytest.mark.parametrize("shape", ["random", "slivers", "parallel", "points"])
@pytest.mark.parametrize("kind", ["edges", "vertices"])
def test_no_pair_within_reach_is_ruled_out(kind, shape, origin):
    rng = np.random.default_rng(3)
    one, other = pairs_at(kind, shape, 0.02, np.array([origin, -origin, 1.0]), rng)
    p = np.concatenate([one.reshape(-1, 3), other.reshape(-1, 3)])
    extra = rng.uniform(0, 0.004, len(p)) * (rng.random(len(p)) < 0.5)
    reach, truth = 0.01, sampled_distances(one, other)
    first, second = (np.arange(each.shape[0] * each.shape[1]).reshape(each.shape[:2]) for each in (one, other))
    second = second + one.shape[0] * one.shape[1]
    widest = extra[first].max(axis=1) + extra[second].max(axis=1)
    near, lower, ends = np.empty((6, len(p)), np.float32), np.empty(PAIRS, np.float32), np.empty((4, PAIRS), np.uint32)
    extent = round_positions(p, extra, near)
    batch = np.zeros((3, PAIRS), np.int32)
    if kind == "edges":
        edges = np.concatenate([first, second]).astype(np.int32)
        batch[0], batch[1] = np.arange(PAIRS), PAIRS + np.arange(PAIRS)
        number = keep_edges(PAIRS, reach, extent, edges, near, batch, ends, lower)
        kept = batch[0, :number]
    else:
        batch[0], batch[1] = first[:, 0], np.arange(PAIRS)
        number = keep_vertices(PAIRS, reach, extent, second.astype(np.int32), near, batch, ends, lower)
        kept = batch[1, :number]
    within = np.flatnonzero(truth < reach + widest)
    assert len(within) > 10 and np.all(np.diff(kept) > 0)
    assert set(within) <= set(kept.tolist())
    # and a bound that rules nothing out would be none: of those farther away by more than the sampling's error most are gone
    beyond = np.flatnonzero(truth > reach + widest + 0.004)
    assert np.isin(beyond, kept).mean() < 0.1
    # in the order in which they came, with a bound below the sampled distance
    assert np.all(lower <= truth - widest + 1e-5 + 1e-6 * extent)
