"""Laws of SE(3), in float64, with the angles where formulas break: near zero and near pi."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.geometry import se3

ANGLES = [0.0, 1e-14, 1e-9, 1e-6, 0.99e-5, 1.01e-5, 1e-3, 0.5, 2.0, 3.0,
          np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]  # fmt: skip


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def random_transform(rng: np.random.Generator) -> np.ndarray:
    return se3.exp(np.concatenate([rng.normal(size=3) * 3, rng.normal(size=3)]))


def unit(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp_at_every_angle(angle, rng):
    for _ in range(20):
        xi = np.concatenate([rng.normal(size=3), angle * unit(rng)])
        np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=2e-9, rtol=0)


@pytest.mark.parametrize("angle", [*ANGLES, np.pi])
def test_exp_undoes_log_at_every_angle(angle, rng):
    for _ in range(20):
        transform = se3.exp(np.concatenate([rng.normal(size=3), angle * unit(rng)]))
        np.testing.assert_allclose(se3.exp(se3.log(transform)), transform, atol=1e-9)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.0, 0.8]]]))
def test_half_turns_have_angle_pi(axis):
    rotation = 2 * np.outer(axis, axis) - np.eye(3)  # the exact rotation by pi about an axis
    phi = se3.rotation_log(rotation)
    assert np.linalg.norm(phi) == pytest.approx(np.pi, abs=1e-12)
    np.testing.assert_allclose(se3.rotation_exp(phi), rotation, atol=1e-12)


def test_exp_agrees_with_its_power_series(rng):
    for scale in (1e-7, 1e-5, 1e-4, 0.3):
        xi = scale * rng.normal(size=6)
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
        series, term = np.eye(4), np.eye(4)
        for order in range(1, 25):
            term = term @ generator / order
            series += term
        np.testing.assert_allclose(se3.exp(xi), series, atol=1e-15, rtol=1e-12)


def test_rotations_are_orthonormal_and_right_handed(rng):
    for angle in ANGLES:
        rotation = se3.rotation_exp(angle * unit(rng))
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)


def test_inverse_is_a_two_sided_inverse_and_works_on_stacks(rng):
    stack = np.array([random_transform(rng) for _ in range(5)])
    np.testing.assert_allclose(
        se3.inverse(stack) @ stack, np.tile(np.eye(4), (5, 1, 1)), atol=1e-14
    )
    np.testing.assert_allclose(
        stack @ se3.inverse(stack), np.tile(np.eye(4), (5, 1, 1)), atol=1e-14
    )
    np.testing.assert_array_equal(se3.inverse(stack)[2], se3.inverse(stack[2]))


def test_adjoint_moves_a_perturbation_from_right_to_left(rng):
    for _ in range(20):
        transform, xi = random_transform(rng), 0.7 * rng.normal(size=6)
        left = se3.exp(se3.adjoint(transform) @ xi) @ transform
        np.testing.assert_allclose(transform @ se3.exp(xi), left, atol=1e-13)


def test_adjoint_is_a_homomorphism(rng):
    a, b = random_transform(rng), random_transform(rng)
    np.testing.assert_allclose(se3.adjoint(a @ b), se3.adjoint(a) @ se3.adjoint(b), atol=1e-12)
    np.testing.assert_allclose(se3.adjoint(se3.inverse(a)) @ se3.adjoint(a), np.eye(6), atol=1e-12)


def test_points_are_carried_from_b_to_a(rng):
    a_from_b, b_from_c = random_transform(rng), random_transform(rng)
    points = rng.normal(size=(9, 3))
    chained = se3.transform_points(a_from_b, se3.transform_points(b_from_c, points))
    np.testing.assert_allclose(
        se3.transform_points(a_from_b @ b_from_c, points), chained, atol=1e-12
    )
    quarter_turn = se3.exp([1.0, 2.0, 3.0, 0, 0, 0]) @ se3.exp([0, 0, 0, 0, 0, np.pi / 2])
    np.testing.assert_allclose(
        se3.transform_points(quarter_turn, [[1, 0, 0]]), [[1, 3, 3]], atol=1e-15
    )


def test_quaternions_are_wxyz_unit_and_of_positive_w(rng):
    np.testing.assert_allclose(se3.quaternion_from_rotation(np.eye(3)), [1, 0, 0, 0])
    quarter = se3.rotation_exp([0, 0, np.pi / 2])
    np.testing.assert_allclose(
        se3.quaternion_from_rotation(quarter), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15
    )
    for angle in ANGLES:
        rotation = se3.rotation_exp(angle * unit(rng))
        q = se3.quaternion_from_rotation(rotation)
        assert q[0] >= 0
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)
        np.testing.assert_allclose(se3.rotation_from_quaternion(q), rotation, atol=1e-9)


def test_quaternion_product_is_rotation_product(rng):
    a, b = rng.normal(size=(2, 6, 4))
    np.testing.assert_allclose(
        se3.rotation_from_quaternion(se3.quaternion_multiply(a, b)),
        se3.rotation_from_quaternion(a) @ se3.rotation_from_quaternion(b),
        atol=1e-13,
    )


def test_orthonormalised_is_nearest_rotation_and_never_a_reflection(rng):
    transform = random_transform(rng)
    spoiled = transform.copy()
    spoiled[:3, :3] += 1e-4 * rng.normal(size=(3, 3))
    repaired = se3.orthonormalised(spoiled)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(repaired, transform, atol=3e-4)
    mirrored = np.diag([1.0, 1.0, -1.0, 1.0])
    assert np.linalg.det(se3.orthonormalised(mirrored)[:3, :3]) == pytest.approx(1.0)


def test_everything_is_float64(rng):
    single = random_transform(rng).astype(np.float32)
    for result in (se3.inverse(single), se3.log(single), se3.exp(np.zeros(6, np.float32)),
                   se3.adjoint(single), se3.rotation_log(single[:3, :3]),
                   se3.quaternion_from_rotation(single[:3, :3])):  # fmt: skip
        assert result.dtype == np.float64
