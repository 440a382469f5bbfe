import numpy as np
import pytest

from holdfast.plants.library.five_sensors import build

# DECOMPOSE, Section VI, written down again
C = [[1, 0, 0], [1, 1, -1], [1, 2, 1], [1, -1, -0.5], [-0.5, 1, 1]]


@pytest.mark.parametrize(("stable", "third"), [(False, -2.0), (True, 0.8)])
def test_matrices(stable, third):
    plant = build(stable=stable)
    np.testing.assert_array_equal(plant.A, np.diag([1.0, 1.0, third]))
    np.testing.assert_array_equal(plant.C, C)
    np.testing.assert_array_equal(plant.Q, np.eye(3))
    np.testing.assert_array_equal(plant.R, np.eye(5))
    assert plant.constant


def test_names():
    plant = build()
    assert plant.states == ("x1", "x2", "x3")
    assert plant.outputs == ("y1", "y2", "y3", "y4", "y5")
    assert (plant.inputs, plant.attacks, plant.dt) == ((), (), 1.0)


@pytest.mark.parametrize("stable", [False, True])
def test_no_sensor_alone_sees_the_state_and_any_two_may_be_missing(stable):
    A = np.asarray(build(stable=stable).A)

    def rank(rows):
        return np.linalg.matrix_rank(
            np.vstack([np.array(C)[rows] @ np.linalg.matrix_power(A, k) for k in range(3)])
        )

    assert [rank([i]) for i in range(5)] == [1, 2, 2, 2, 2]
    for i in range(5):
        for j in range(i):
            assert rank([k for k in range(5) if k not in (i, j)]) == 3
