"""Blocks that agree on the Gaussians near their borders."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.errors import CorruptData
from magic_core.gaussians import GaussianCloud
from magic_server.globalmap.blocks import Block
from magic_server.globalmap.consensus import Guests, agreed, decode, encode, guests_of


def cloud(count: int, *, seed: int = 0) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    return GaussianCloud.from_arrays(
        rng.uniform(-1.0, 1.0, (count, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.uniform(0.005, 0.02, (count, 3)),
        opacities=rng.uniform(0.1, 0.9, count),
        colours=rng.uniform(0.0, 1.0, (count, 3)),
    )


def guest(own: GaussianCloud, places: list[int], weight: float) -> Guests:
    weights = np.full(len(places), weight, np.float32)
    return Guests(0, np.array(places), weights, own)


def block(low: float, high: float) -> Block:
    """A slab along x."""
    corners = np.array([[low, -np.inf, -np.inf], [high, np.inf, np.inf]])
    return Block(corners[0], corners[1], (), np.full(3, -9.0), np.full(3, 9.0))


def test_without_guests_a_block_keeps_what_it_made():
    own = cloud(20)
    for ours, theirs in zip(own.arrays(), agreed(own, []).arrays(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_guests_count_by_their_weight_where_they_are():
    own, other = cloud(4), cloud(2, seed=1)
    made = agreed(own, [guest(other, [1, 3], 0.5)])
    assert len(made) == 4
    np.testing.assert_allclose(made.means[[0, 2]], own.means[[0, 2]], atol=1e-6)
    wanted = (own.means[[1, 3]] + 0.5 * other.means) / 1.5
    np.testing.assert_allclose(made.means[[1, 3]], wanted, atol=1e-6)
    logit = lambda p: np.log(p / (1.0 - p))  # noqa: E731
    wanted = (logit(own.opacities[[1, 3]]) + 0.5 * logit(other.opacities)) / 1.5
    np.testing.assert_allclose(logit(made.opacities[[1, 3]]), wanted, atol=1e-5)
    wanted = (np.log(own.scales[[1, 3]]) + 0.5 * np.log(other.scales)) / 1.5
    np.testing.assert_allclose(np.log(made.scales[[1, 3]]), wanted, atol=1e-5)


def test_a_rotation_and_its_negative_quaternion_are_the_same_word():
    own = cloud(5)
    opposite = GaussianCloud(own.means, -own.quaternions, own.scales, own.opacities, own.colours)
    made = agreed(own, [guest(opposite, list(range(5)), 1.0)])
    np.testing.assert_allclose(made.quaternions, own.quaternions, atol=1e-6)


def test_a_way_into_logits_and_back_is_not_taken_for_being_shown():
    before = cloud(1000)
    before.means[:] = 0.0
    logits = np.log(before.opacities / (1.0 - before.opacities))
    opacities = (1.0 / (1.0 + np.exp(-logits))).astype(np.float32)
    assert (opacities != before.opacities).any()
    opacities[:3] += 1e-4
    after = GaussianCloud(
        before.means, before.quaternions, before.scales, opacities, before.colours
    )
    found = guests_of(block(-1.0, 1.0), before, after, owner=3, places=np.arange(1000))
    assert found.places.tolist() == [0, 1, 2]


def test_a_block_speaks_of_what_it_showed_and_the_less_the_farther():
    before = cloud(4)
    before.means[:, 0] = [0.0, 0.15, 0.15, 0.5]
    after = GaussianCloud(*(part.copy() for part in before.arrays()))
    after.means[[0, 1, 3]] += 0.001  # the third was never drawn
    found = guests_of(block(-np.inf, 0.0), before, after, owner=3, places=np.arange(10, 14))
    assert found.owner == 3
    assert found.places.tolist() == [10, 11]
    np.testing.assert_allclose(found.weights, [1.0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(found.cloud.means, after.means[:2])


def test_what_is_handed_over_survives_the_way():
    ours, theirs = cloud(3), cloud(2, seed=2)
    written = encode(
        [guest(ours, [5, 6, 9], 0.25), Guests(7, np.array([1, 2]), np.ones(2), theirs)]
    )
    (found,) = decode(written, owners=[7, 8])
    assert (found.owner, found.places.tolist()) == (7, [1, 2])
    np.testing.assert_allclose(found.cloud.means, theirs.means, atol=1e-6)
    assert [one.owner for one in decode(written, owners=range(9))] == [0, 7]


@pytest.mark.parametrize("damage", [b"", b"not a file", None])
def test_a_damaged_file_is_named(damage: bytes | None):
    written = encode([guest(cloud(3), [0, 1, 2], 1.0)])
    with pytest.raises(CorruptData, match="damaged"):
        decode(written[: len(written) // 2] if damage is None else damage, owners=[0])
