"""Linear algebra in lanes: each lane has matrices and exchanges of rows of its own."""

import numpy as np
import pytest

from tests.problems import called
from twoloop.kernels.lanes import lane_algebra
from twoloop.kernels.lanes.lane_room import FINE, LANES, N_FIELDS

N = 5


@pytest.mark.parametrize("imaginary", [False, True])
def test_systems_are_solved_with_rows_exchanged_as_each_lane_needs(imaginary):
    random = np.random.default_rng(7)
    matrices, x = random.standard_normal((2, LANES, N, N)), random.standard_normal((2, LANES, N))
    matrices[:, 1::2, 0, 0] = 0.0  # no pivot without an exchange
    matrices[:, 2, :, 0] *= 1e-9
    parts = 2 if imaginary else 1
    A = matrices[0] + 1j * matrices[1] * (parts - 1)
    right = np.einsum("kij,kj->ki", A, x[0] + 1j * x[1] * (parts - 1))
    matrix, pivots = N_FIELDS, N_FIELDS + 2 * N * N
    room = np.zeros((pivots + 3 * N, LANES))
    room[FINE] = 1.0
    room[matrix : matrix + 2 * N * N] = np.concatenate([A.real, A.imag], axis=1).reshape(LANES, -1).T
    room[pivots + N :] = np.concatenate([right.real, right.imag], axis=1).T
    flat, apart = room.ravel(), N * N * (parts - 1)
    called(lane_algebra.factor_lanes, flat, matrix, pivots, N, apart)
    called(lane_algebra.solve_lanes, flat, matrix, pivots, N, apart, pivots + N)
    found = room[pivots + N :].reshape(2, N, LANES)[:parts]
    assert np.abs(found - x[:parts].transpose(0, 2, 1)).max() < 1e-4 and (room[FINE] == 1.0).all()
    assert np.delete(np.abs(found - x[:parts].transpose(0, 2, 1)), 2, axis=2).max() < 1e-11


def test_a_singular_matrix_is_noted_in_its_lane_alone():
    room = np.zeros((N_FIELDS + N * N + N, LANES))
    room[FINE] = 1.0
    room[N_FIELDS : N_FIELDS + N * N] = np.eye(N).reshape(-1, 1)
    room[N_FIELDS + 6, 3] = 0.0
    called(lane_algebra.factor_lanes, room.ravel(), N_FIELDS, N_FIELDS + N * N, N, 0)
    assert np.flatnonzero(room[FINE] != 1.0).tolist() == [3]
