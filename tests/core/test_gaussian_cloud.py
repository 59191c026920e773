"""The Gaussian cloud: moving it, picking from it, refusing bad ones."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3


def random_cloud(n: int = 40, seed: int = 3) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    return GaussianCloud.from_arrays(
        rng.normal(size=(n, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.uniform(0.005, 0.2, (n, 3)),
        opacities=rng.uniform(0.05, 0.95, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )


def covariances(cloud: GaussianCloud) -> np.ndarray:
    factor = se3.rotation_from_quaternion(cloud.quaternions) * cloud.scales[:, None, :]
    return factor @ np.swapaxes(factor, 1, 2)


def test_moving_turns_means_and_covariances_alike():
    cloud, motion = random_cloud(), se3.exp([0.4, -1.0, 2.0, 0.7, -0.3, 1.9])
    moved = cloud.transformed(motion)
    rotation = motion[:3, :3]
    np.testing.assert_allclose(moved.means, se3.transform_points(motion, cloud.means), atol=1e-6)
    np.testing.assert_allclose(
        covariances(moved), rotation @ covariances(cloud) @ rotation.T, atol=1e-7
    )
    np.testing.assert_array_equal(moved.opacities, cloud.opacities)
    np.testing.assert_array_equal(moved.colours, cloud.colours)


def test_moving_there_and_back_gives_the_same_cloud():
    cloud, motion = random_cloud(), se3.exp([3.0, 1.0, -2.0, 2.1, 0.3, -1.2])
    back = cloud.transformed(motion).transformed(se3.inverse(motion))
    np.testing.assert_allclose(back.means, cloud.means, atol=2e-6)
    np.testing.assert_allclose(covariances(back), covariances(cloud), atol=1e-7)
    back.validate()


def test_select_takes_masks_and_indices():
    cloud = random_cloud()
    mask = cloud.opacities > 0.5
    np.testing.assert_array_equal(cloud.select(mask).means, cloud.means[mask])
    np.testing.assert_array_equal(cloud.select(np.array([3, 1])).colours, cloud.colours[[3, 1]])
    assert all(array.flags.c_contiguous for array in cloud.select(mask).arrays())


def test_concatenate_keeps_order_and_accepts_nothing():
    a, b = random_cloud(5, seed=1), random_cloud(7, seed=2)
    both = GaussianCloud.concatenate([a, b])
    assert len(both) == 12
    np.testing.assert_array_equal(both.means[5:], b.means)
    assert len(GaussianCloud.concatenate([])) == 0
    GaussianCloud.empty().validate()


@pytest.mark.parametrize(
    ("field", "spoil"),
    [
        ("means", lambda c: c.means.__setitem__((0, 0), np.nan)),
        ("scales", lambda c: c.scales.__setitem__((1, 2), 0.0)),
        ("scales", lambda c: c.scales.__setitem__((1, 2), np.inf)),
        ("quaternions", lambda c: c.quaternions.__setitem__(0, 2 * c.quaternions[0])),
        ("opacities", lambda c: c.opacities.__setitem__(3, 1.5)),
        ("colours", lambda c: c.colours.__setitem__((2, 0), -np.inf)),
    ],
)
def test_a_bad_cloud_is_refused_by_field(field, spoil):
    cloud = random_cloud()
    cloud.validate()
    spoil(cloud)
    with pytest.raises(InvalidInput) as caught:
        cloud.validate("submap.gaussians")
    assert [v.field for v in caught.value.violations] == [f"submap.gaussians.{field}"]


def test_a_wrong_shape_is_refused():
    a = random_cloud()
    bad = GaussianCloud(a.means, a.quaternions[:, :3], a.scales, a.opacities, a.colours)
    with pytest.raises(InvalidInput, match="shape"):
        bad.validate()
