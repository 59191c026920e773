"""Morton order keeps every Gaussian and brings neighbours together."""

import numpy as np

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import BITS, in_morton_order, morton_codes


def cloud_at(means):
    n = len(means)
    rng = np.random.default_rng(0)
    return GaussianCloud.from_arrays(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.full((n, 3), 0.01),
        opacities=rng.uniform(0.1, 0.9, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )


def test_codes_interleave_the_bits_of_the_axes():
    rng = np.random.default_rng(1)
    grid = rng.integers(0, 2**BITS, (50, 3))
    expected = [
        sum(int(g[axis] >> bit & 1) << (3 * bit + axis) for bit in range(BITS) for axis in range(3))
        for g in grid
    ]
    assert morton_codes(grid).tolist() == expected


def test_every_gaussian_is_kept_once_with_its_own_parameters():
    cloud = cloud_at(np.random.default_rng(2).uniform(-3, 5, (500, 3)))
    ordered = in_morton_order(cloud)
    rows = [np.column_stack([a.reshape(len(c), -1) for a in c.arrays()]) for c in (cloud, ordered)]
    assert sorted(map(tuple, rows[0])) == sorted(map(tuple, rows[1]))


def test_neighbours_in_memory_are_near_each_other():
    cloud = cloud_at(np.random.default_rng(3).uniform(0, 1, (4096, 3)))

    def mean_step(c):
        return np.linalg.norm(np.diff(c.means, axis=0), axis=1).mean()

    # A regular grid of 16^3 cells walked cell by cell would step 1/16 = 0.0625.
    assert mean_step(in_morton_order(cloud)) < 0.1 < mean_step(cloud)


def test_clouds_without_extent_are_left_in_order():
    for n in (0, 1, 3):
        cloud = cloud_at(np.zeros((n, 3)))
        np.testing.assert_array_equal(in_morton_order(cloud).opacities, cloud.opacities)
