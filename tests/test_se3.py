"""Rigid transforms against SciPy and their own algebra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.se3 import SE3, quaternion_to_matrix, rotation_angle, rotation_vector_to_matrix, skew

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
rotation_vectors = vectors.map(lambda v: v * 3.0)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers).map(np.array).filter(lambda q: float(np.linalg.norm(q)) > 1e-3)
)
transforms = st.builds(lambda q, t: SE3.from_quaternion(q, 100 * t), quaternions, vectors)


@given(rotation_vectors)
def test_rotation_vector_agrees_with_scipy(rotvec: np.ndarray) -> None:
    assert rotation_vector_to_matrix(rotvec) == pytest.approx(Rotation.from_rotvec(rotvec).as_matrix(), abs=1e-12)


@given(quaternions)
def test_quaternion_agrees_with_scipy(wxyz: np.ndarray) -> None:
    truth = Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix()
    assert quaternion_to_matrix(wxyz) == pytest.approx(truth, abs=1e-12)


@given(quaternions)
def test_quaternion_comes_back_with_positive_w(wxyz: np.ndarray) -> None:
    unit = wxyz / np.linalg.norm(wxyz)
    back = SE3.from_quaternion(wxyz, np.zeros(3)).wxyz
    assert back[0] >= 0
    assert abs(back @ unit) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turn_has_a_quaternion(axis: np.ndarray) -> None:
    half_turn = SE3(rotation_vector_to_matrix(np.pi * axis), np.zeros(3))
    assert np.abs(half_turn.wxyz) == pytest.approx([0.0, *axis], abs=1e-12)


@given(transforms, transforms, vectors)
def test_product_applies_right_then_left(T_a_b: SE3, T_b_c: SE3, p_c: np.ndarray) -> None:
    assert (T_a_b @ T_b_c).apply(p_c) == pytest.approx(T_a_b.apply(T_b_c.apply(p_c)), abs=1e-9)
    assert (T_a_b @ T_b_c).matrix == pytest.approx(T_a_b.matrix @ T_b_c.matrix, abs=1e-9)


@given(transforms, vectors)
def test_inverse_undoes(T_a_b: SE3, p_b: np.ndarray) -> None:
    assert T_a_b.inverse().apply(T_a_b.apply(p_b)) == pytest.approx(p_b, abs=1e-9)
    assert (T_a_b @ T_a_b.inverse()).matrix == pytest.approx(np.eye(4), abs=1e-9)


def test_apply_takes_arrays_of_points() -> None:
    T = SE3.from_quaternion([0.9, 0.1, -0.3, 0.2], [1.0, 2.0, 3.0])
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    assert T.apply(points)[2, 3] == pytest.approx(T.R @ points[2, 3] + T.t, abs=1e-12)


@given(rotation_vectors.filter(lambda v: 1e-4 < float(np.linalg.norm(v)) < np.pi - 1e-3))
def test_angle_is_the_length_of_the_rotation_vector(rotvec: np.ndarray) -> None:
    assert rotation_angle(rotation_vector_to_matrix(rotvec)) == pytest.approx(float(np.linalg.norm(rotvec)), abs=1e-9)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v: np.ndarray, u: np.ndarray) -> None:
    assert skew(v) @ u == pytest.approx(np.cross(v, u), abs=1e-12)
