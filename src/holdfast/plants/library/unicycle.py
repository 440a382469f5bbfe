"""A wheeled robot that knows its odometry and sees landmarks: range and bearing to each."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from holdfast.numerics.linalg import dot, sandwich
from holdfast.parts import InvalidValue, Plant
from holdfast.plants.angles import shorter_way

INPUTS = ("v", "omega")
SMALL = 0.05
"""rad. Where sin(z) / z goes over to its series, whose first term left out is below 3e-21 there."""


class UnicyclePlant(Plant):
    """x = (x, y, heading), u = (v, omega) held over a sample; range and bearing to L landmarks.

    With s = (g_v v + d_v) dt and t = (g_w omega + d_omega) dt, (g_v, g_w) the ``gain``, exactly

        x += s sin(t/2)/(t/2) cos(heading + t/2),  y += s sin(t/2)/(t/2) sin(heading + t/2),
        heading += t  (not wrapped);

    with a, b what is ahead and to the left of the robot in the way to landmark i (m),

        range_i = scale hypot(a, b), or scale a for a depth,  bearing_i = atan2(b, a).

    Process noise: variance ``drive`` (2) of v and omega over a sample, through the Jacobian of
    the motion, plus ``floor`` (3). Range variance range_sd^2 + (range_share range_i)^2.
    ``moves`` (2 x nd) and ``shows`` (2 L x nd) say where the attack channels enter.
    """

    landmarks: Float[Array, "L 2"]
    scale: Float[Array, ""]
    gain: Float[Array, " 2"]
    drive: Float[Array, " 2"]
    floor: Float[Array, " 3"]
    range_sd: Float[Array, ""]
    range_share: Float[Array, ""]
    bearing_sd: Float[Array, ""]
    moves: Float[Array, "2 nd"]
    shows: Float[Array, "ny nd"]
    depth: bool = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    attacks: tuple[str, ...] = eqx.field(static=True)

    def transition(self, k, x, u, d) -> Float[Array, " 3"]:
        """The pose at k from that at k-1."""
        return self._moved(x, self.gain * u + dot(self.moves, d))

    def output(self, k, x, u, d) -> Float[Array, " ny"]:
        """Ranges (m), then bearings (rad, from -pi to pi) of all landmarks, seen or not."""
        ahead, left = self._ahead_and_left(x)
        far = ahead if self.depth else jnp.hypot(ahead, left)
        return jnp.concatenate([self.scale * far, jnp.arctan2(left, ahead)]) + dot(self.shows, d)

    def noise(self, k, x, u) -> tuple[Float[Array, "3 3"], Float[Array, "ny ny"]]:
        """Q at a pose x before the motion, R at a pose x that is measured."""
        J = jax.jacfwd(lambda speeds: self._moved(x, speeds))(self.gain * u)
        Q = sandwich(J, jnp.diag(self.drive)) + jnp.diag(self.floor)
        ranges = self.output(k, x, u, jnp.zeros(len(self.attacks)))[: len(self.landmarks)]
        far = self.range_sd**2 + (self.range_share * ranges) ** 2
        return Q, jnp.diag(jnp.concatenate([far, jnp.full(far.shape, self.bearing_sd**2)]))

    def innovation(self, y, expected) -> Float[Array, " ny"]:
        """How far y is from what was expected, bearings the shorter way round."""
        return shorter_way(y - expected, self.outputs, self.outputs[len(self.landmarks) :])

    def _moved(self, x, speeds) -> Float[Array, " 3"]:
        half = 0.5 * self.dt * speeds[1]
        chord, heading = self.dt * speeds[0] * _sinc(half), x[2] + half
        return x + jnp.stack([chord * jnp.cos(heading), chord * jnp.sin(heading), 2 * half])

    def _ahead_and_left(self, x):
        way = self.landmarks - x[:2]
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        return c * way[:, 0] + s * way[:, 1], c * way[:, 1] - s * way[:, 0]


def _sinc(z: Float[Array, ""]) -> Float[Array, ""]:
    """sin(z) / z and its derivative without loss near 0."""
    near = jnp.abs(z) < SMALL
    safe, w = jnp.where(near, 1.0, z), z * z
    series = 1 - w / 6 * (1 - w / 20 * (1 - w / 42 * (1 - w / 72)))
    return jnp.where(near, series, jnp.sin(safe) / safe)


def build(
    *,
    landmarks: Sequence[Sequence[float]],
    names: Sequence[str] | None = None,
    dt: float = 0.1,
    measures: Literal["distance", "depth"] = "distance",
    range_scale: float = 1.0,
    speed_scale: float = 1.0,
    turn_scale: float = 1.0,
    range_sd: float = 0.1,
    range_share: float = 0.0,
    bearing_sd: float = 0.02,
    speed_noise: float = 0.016,
    turn_noise: float = 0.03,
    position_floor: float = 1e-3,
    heading_floor: float = 1e-3,
    attacked: Sequence[Literal["range", "bearing", "odometry"]] = ("range", "odometry"),
) -> UnicyclePlant:
    """A robot among ``landmarks`` ([x, y] in m each), called ``names`` ("1", "2", .. if not given).

    States x, y (m), heading (rad); inputs v (m/s), omega (rad/s), the odometry; outputs
    range:NAME (m), then bearing:NAME (rad). ``measures``: "depth" for a camera that tells how
    far ahead a landmark is rather than its distance, ``range_scale`` times too large. The robot
    moves ``speed_scale`` v and turns ``turn_scale`` omega.
    ``range_sd`` (m), ``range_share`` (per metre of range), ``bearing_sd`` (rad) of a sample;
    ``speed_noise`` (m/s^0.5) and ``turn_noise`` (rad/s^0.5): densities of white noise on v and
    omega, so that over a time T distance and heading spread by noise sqrt(T) whatever dt is;
    ``position_floor`` (m), ``heading_floor`` (rad): what a row adds at least.

    ``attacked``: which attack channels there are. range:NAME, bearing:NAME add to that output.
    v, omega ("odometry") add to the (scaled) input in the motion: the truth moves as u + d, so
    an odometry that tells a too much (u = truth + a) is an attack of d = -a.

    Raises `InvalidValue` for a number or a name that cannot be.

    Source: Thrun, Burgard and Fox, *Probabilistic Robotics*, sec. 5.3 and 6.6.
    """
    positive = {
        "dt": dt,
        "range_scale": range_scale,
        "speed_scale": speed_scale,
        "turn_scale": turn_scale,
        "range_sd": range_sd,
        "bearing_sd": bearing_sd,
    }
    others = {
        "range_share": range_share,
        "speed_noise": speed_noise,
        "turn_noise": turn_noise,
        "position_floor": position_floor,
        "heading_floor": heading_floor,
    }
    _check(positive, others, attacked)
    places, named = _placed(landmarks, names)
    seen = {kind: tuple(f"{kind}:{name}" for name in named) for kind in ("range", "bearing")}
    outputs = seen["range"] + seen["bearing"]
    channels = [name for kind in attacked for name in seen.get(kind, INPUTS)]
    into = np.array([[name == c for c in channels] for name in (*INPUTS, *outputs)], float)
    into = into.reshape(2 + len(outputs), len(channels))
    return UnicyclePlant(
        landmarks=jnp.asarray(places),
        scale=jnp.asarray(float(range_scale)),
        gain=jnp.asarray([float(speed_scale), float(turn_scale)]),
        drive=jnp.asarray([speed_noise**2 / dt, turn_noise**2 / dt]),
        floor=jnp.asarray([position_floor**2, position_floor**2, heading_floor**2]),
        range_sd=jnp.asarray(float(range_sd)),
        range_share=jnp.asarray(float(range_share)),
        bearing_sd=jnp.asarray(float(bearing_sd)),
        moves=jnp.asarray(into[:2]),
        shows=jnp.asarray(into[2:]),
        depth=measures == "depth",
        dt=float(dt),
        states=("x", "y", "heading"),
        inputs=INPUTS,
        outputs=outputs,
        attacks=tuple(channels),
    )


def _placed(
    landmarks: Sequence[Sequence[float]], names: Sequence[str] | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Where the landmarks are and what they are called."""
    if not len(landmarks) or any(len(place) != 2 for place in landmarks):
        raise InvalidValue("landmarks", landmarks, "one or more [x, y]")
    places = np.asarray(landmarks, float)
    if not np.all(np.isfinite(places)):
        raise InvalidValue("landmarks", "NaN or infinity", "finite numbers")
    named = tuple(str(i + 1) for i in range(len(places))) if names is None else tuple(names)
    if len(named) != len(places) or len(set(named)) != len(named):
        raise InvalidValue("names", list(named), f"{len(places)} names that differ")
    return places, named


def _check(positive: dict[str, float], others: dict[str, float], attacked: Sequence[str]) -> None:
    for key, value in positive.items():
        if not (np.isfinite(value) and value > 0):
            raise InvalidValue(key, value, "a number above 0")
    for key, value in others.items():
        if not (np.isfinite(value) and value >= 0):
            raise InvalidValue(key, value, "a number, 0 or more")
    if len(set(attacked)) != len(attacked):
        raise InvalidValue("attacked", list(attacked), "each once")
