import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from holdfast.parts import InvalidValue
from holdfast.plants.library.swing_pandapower import from_pandapower


def net(**changes):
    """Tables as pandapower has them: 3 buses of 110 kV, 2 of 20 kV; 50 MVA."""
    tables = {
        "sn_mva": 50.0,
        "bus": pd.DataFrame({"vn_kv": [110.0, 110.0, 110.0, 20.0, 20.0]}, index=[0, 2, 3, 7, 8]),
        "line": pd.DataFrame(
            {
                "from_bus": [0, 2, 3, 0, 7],
                "to_bus": [2, 3, 0, 3, 8],
                "x_ohm_per_km": [0.4, 0.5, 0.3, 0.3, 0.2],
                "length_km": [10.0, 20.0, 30.0, 30.0, 5.0],
                "parallel": [1, 2, 1, 1, 1],
                "in_service": [True, True, True, False, True],
            },
            index=[4, 5, 6, 9, 11],
        ),
        "trafo": pd.DataFrame(
            {
                "hv_bus": [3, 2],
                "lv_bus": [7, 8],
                "vk_percent": [13.0, 10.0],
                "vkr_percent": [5.0, 0.0],
                "sn_mva": [25.0, 40.0],
                "parallel": [1, 1],
                "in_service": [True, True],
            }
        ),
        "gen": pd.DataFrame({"bus": [8], "in_service": [True]}),
        "ext_grid": pd.DataFrame({"bus": [0], "in_service": [True]}),
        "load": pd.DataFrame(
            {
                "bus": [7, 2, 7, 3],
                "p_mw": [10.0, 5.0, 2.5, 99.0],
                "scaling": [1.0, 1.0, 2.0, 1.0],
                "in_service": [True, True, True, False],
            }
        ),
        "switch": pd.DataFrame(
            {"bus": [3, 2], "element": [6, 1], "et": ["l", "t"], "closed": [False, True]}
        ),
    }
    return tables | changes


def test_branches_generators_and_loads_are_those_in_service():
    plant = from_pandapower(net(), attacks=["actuator:8"], switches=[["0-2"]])
    assert plant.buses == (0, 2, 3, 7, 8)
    ends = np.asarray(plant.buses)[np.asarray(plant.ends)].T.tolist()
    assert ends == [[0, 2], [2, 3], [7, 8], [3, 7], [2, 8]]
    high, low = 110.0**2 / 50.0, 20.0**2 / 50.0
    x = [4.0 / high, 5.0 / high, 1.0 / low, 0.12 * 50 / 25, 0.10 * 50 / 40]
    np.testing.assert_allclose(plant.strength, 1.0 / np.asarray(x), rtol=1e-14)
    np.testing.assert_array_equal(plant.load, [0, 1, 1, 1, 0])
    np.testing.assert_allclose(plant.demand, [0, 0.1, 0, 0.3, 0], rtol=1e-14, atol=0)
    assert plant.positions == ("normal", "0-2")
    assert plant.output(1, jnp.zeros(10), jnp.zeros(5), jnp.zeros(1)).shape == (15,)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"trafo3w": pd.DataFrame({"hv_bus": [0]})}, "net.trafo3w"),
        (
            {"switch": pd.DataFrame({"bus": [0], "element": [2], "et": ["b"], "closed": [True]})},
            "net.switch",
        ),
        ({"line": net()["line"][:0], "trafo": net()["trafo"][:0]}, "net"),
        ({"trafo": net()["trafo"].assign(vk_percent=5.0)}, "net"),
    ],
)
def test_what_the_equation_lacks_is_refused(changes, key):
    with pytest.raises(InvalidValue) as refused:
        from_pandapower(net(**changes))
    assert refused.value.key == key
