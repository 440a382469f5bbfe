"""Plants that a scenario's Python code makes: one line about what is wrong with them, exit 2."""

import pytest

GOOD = """\
import jax.numpy as jnp
import numpy as np
from holdfast.plants.nonlinear import nonlinear_plant


def f(x, u, d):
    return x - 0.1 * jnp.sin(x)


def h(x, u, d):
    return x[:1]


def make(*, gain: float = 1.0):
    return nonlinear_plant(f, h, Q=np.eye(2), R=np.eye(1), dt=0.1, states=["a", "b"],
                           outputs=["seen"])
"""
SCENARIO = """\
[plant]
kind = "python"
target = "TARGET:make"

[estimator]
kind = "extended"
x0 = [0.1, 0.2]
P0 = [[1, 0], [0, 1]]

[run]
steps = 3
"""


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "return x[:1]",
            "return x",
            "plant.target: found h: shape (2,), expected shape (1,)",
        ),
        (
            "return x - 0.1 * jnp.sin(x)",
            "return x - 0.1 * np.sin(x)",
            "plant.target: found f: a numpy function on a traced value (f, line 7), "
            "expected its namesake in jax.numpy",
        ),
        (
            "return x - 0.1 * jnp.sin(x)",
            "return x if x[0] > 0 else -x",
            "plant.target: found f: an if, while, and, or or not on a traced value (f, line 7), "
            "expected jnp.where(condition, a, b), or & and |: every case is traced at once",
        ),
        pytest.param(
            "return x[:1]",
            "return jnp.sqrt(0.0 * x[:1])",
            "plant.target: found h: a derivative by x that is NaN at every point tried, such as "
            "x = [0.0, 0.0], expected finite values and derivatives near the origin",
            marks=pytest.mark.slow,
        ),
        (
            "    return nonlinear",
            "    [][1]\n    return nonlinear",
            "plant.target: found IndexError: list index out of range, expected a function that "
            "returns a Plant",
        ),
        (
            "def make",
            "def make(:\n",
            "found 'PLANT:make' (SyntaxError: invalid syntax",
        ),
    ],
    ids=["shape", "numpy", "if", "NaN", "raises", "syntax"],
)
def test_what_cannot_be_used_is_one_line(old, new, told, folder, command, request):
    name = f"plant_{request.node.callspec.id}"  # modules stay imported
    (folder / f"{name}.py").write_text(GOOD.replace(old, new))
    path = folder / "python.toml"
    path.write_text(SCENARIO.replace("TARGET", name))
    before = sorted(folder.iterdir())
    code, out, err = command("run", path, "--allow-python", "-o", folder / "report")
    assert (code, out) == (2, "")
    assert err.startswith(f"{path}: plant.target: found ")
    assert told.replace("PLANT", name) in err
    assert err.count("\n") == 1
    assert {p.name for p in folder.iterdir()} <= {p.name for p in before} | {"__pycache__"}


@pytest.mark.slow
def test_a_sound_one_runs(folder, command):
    (folder / "plant_sound.py").write_text(GOOD)
    (folder / "python.toml").write_text(SCENARIO.replace("TARGET", "plant_sound"))
    code, out, _ = command("run", folder / "python.toml", "--allow-python")
    assert code == 0
    assert "state" in out
    (folder / "log.csv").write_text("time,y:seen\n0.1,0.1\n0.2,0.2\n")
    code, out, err = command("replay", folder / "python.toml", folder / "log.csv", "--allow-python")
    assert (code, err) == (0, "")
    assert out.startswith("time,x:a")


def test_its_own_settings_keep_their_names(folder, command):
    refusing = "    raise InvalidValue('gain', gain, 'a number above 0')\n    return nonlinear"
    text = "from holdfast.parts import InvalidValue\n" + GOOD.replace(
        "    return nonlinear", refusing
    )
    (folder / "plant_gain.py").write_text(text)
    (folder / "python.toml").write_text(
        SCENARIO.replace('"TARGET:make"', '"plant_gain:make"\ngain = -1.0')
    )
    code, _, err = command("run", folder / "python.toml", "--allow-python")
    assert code == 2
    assert "plant.gain: found -1.0, expected a number above 0" in err
