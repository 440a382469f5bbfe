"""Swing-equation networks from pandapower (the extra ``grid``); it is not imported here."""

from typing import Any

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.library.swing import network
from holdfast.plants.library.swing_network import SwingNetwork

BRANCHES = ("trafo3w", "impedance", "dcline", "tcsc", "vsc")
"""Tables whose elements would connect buses in a way that (1) does not have."""


def from_pandapower(net: Any, **settings: Any) -> SwingNetwork:
    """The lines, transformers, generators and loads in service of a pandapower network.

    Buses keep their numbers in ``net.bus``. A branch has t = 1 / x with its series reactance x
    per unit of ``net.sn_mva`` (voltages taken as nominal, taps as neutral, resistance and
    charging left out, as in the DC power flow): x = X n_parallel^-1 sn_mva / vn_kv^2 of a line,
    x = sqrt(vk^2 - vkr^2) n_parallel^-1 net.sn_mva / sn_mva of a transformer. A branch with an
    open switch is left out. Buses of ``net.gen`` and ``net.ext_grid`` are generator buses, the
    loads' p_mw is the demand. ``settings``: every other key of `network`.

    Raises `InvalidValue` for branches of another kind, closed switches between two buses, and
    as `network`.
    """
    for table in BRANCHES:
        if table in net and len(net[table]):
            raise InvalidValue(f"net.{table}", f"{len(net[table])} rows", "lines and transformers")
    if np.any((net["switch"]["et"] == "b") & net["switch"]["closed"]):
        raise InvalidValue("net.switch", "closed switches between buses", "one bus instead of two")
    lines = [*_lines(net), *_transformers(net)]
    if not lines:
        raise InvalidValue("net", "no branch in service", "lines or transformers")
    buses = sorted({bus for first, last, _ in lines for bus in (first, last)})
    generators = {
        bus for table in (net["gen"], net["ext_grid"]) for bus in _in_service(table)["bus"]
    }
    loads = _in_service(net["load"])
    power = loads["p_mw"] * loads["scaling"] / net["sn_mva"]
    return network(
        lines=lines,
        generators=sorted(map(int, generators)),
        demand=[float(np.sum(power[loads["bus"] == bus])) for bus in buses],
        **settings,
    )


def _in_service(table: Any) -> Any:
    return table[table["in_service"].astype(bool)]


def _closed(net: Any, table: Any, kind: str) -> Any:
    """The elements in service without an open switch."""
    opened = net["switch"][(net["switch"]["et"] == kind) & ~net["switch"]["closed"].astype(bool)]
    found = _in_service(table)
    return found[~found.index.isin(opened["element"])]


def _lines(net: Any) -> list[list[float]]:
    found = _closed(net, net["line"], "l")
    base = net["bus"]["vn_kv"].loc[found["from_bus"]].to_numpy() ** 2 / net["sn_mva"]
    x = (found["x_ohm_per_km"] * found["length_km"] / found["parallel"]).to_numpy() / base
    return _rows(found["from_bus"], found["to_bus"], x)


def _transformers(net: Any) -> list[list[float]]:
    found = _closed(net, net["trafo"], "t")
    reactive = np.sqrt(found["vk_percent"] ** 2 - found["vkr_percent"] ** 2) / 100.0
    x = reactive * net["sn_mva"] / found["sn_mva"] / found["parallel"]
    return _rows(found["hv_bus"], found["lv_bus"], x.to_numpy())


def _rows(first: Any, last: Any, x: np.ndarray) -> list[list[float]]:
    if np.any(x <= 0):
        raise InvalidValue("net", f"a reactance of {np.min(x):g}", "reactances above 0")
    ends = zip(first, last, 1.0 / x, strict=True)
    return [[float(a), float(b), float(t)] for a, b, t in ends]
