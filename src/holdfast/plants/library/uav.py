"""A flying vehicle seen by GPS and barometer, its accelerations taken as random."""

import numpy as np

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.linear import LinearPlant

AXES = ("north", "east", "down")
GPS = tuple(f"gps_{axis}" for axis in AXES) + tuple(f"gps_{axis}_speed" for axis in AXES)


def build(
    *,
    dt: float = 0.2,
    acceleration_noise: float = 0.097,
    down_acceleration_noise: float = 0.041,
    position_walk: float = 0.0,
    down_position_walk: float = 0.084,
    gps_position_sd: float = 0.058,
    gps_speed_sd: float = 0.132,
    gps_correlation: float = 0.58,
    gps_down_sd: float = 0.088,
    gps_down_speed_sd: float = 0.080,
    gps_down_correlation: float = 0.63,
    baro_sd: float = 0.136,
    baro_walk: float = 0.140,
) -> LinearPlant:
    """The random-acceleration model: no input, no model of the vehicle's own dynamics.

    Per axis, with position p (m), velocity v (m/s) and white noises a (``acceleration_noise``
    q, m/s^1.5) and e (``position_walk`` w, m/s^0.5):  p' = v + e,  v' = a;  the bias b (m) of
    the barometer walks:  b' = e_b  (``baro_walk``, m/s^0.5). Sampled exactly over ``dt``
    seconds, each axis has

        Q = q^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]] + diag(w^2 dt, 0),    Q_bb = baro_walk^2 dt.

    Outputs: GPS position (sd in m) and velocity (sd in m/s), whose errors are correlated
    within an axis by ``gps_correlation``, and barometric height h = -p_down + b + v_h
    (``baro_sd``, m). The keys with ``down`` are the vertical axis, the others each horizontal
    one. One attack channel adds to each GPS output.

    The defaults are maximum-likelihood values over the innovations of one hovering flight of
    a small quadrotor: the height a receiver reports wanders where its horizontal position
    does not, hence the walk of the vertical axis.

    states (7), outputs (7), attacks (6) carry names; shapes follow from those.
    Raises `InvalidValue` where a density or deviation is negative (or 0 where one must not
    be), or a correlation is not inside (-1, 1).

    Source: the white-noise acceleration model, Bar-Shalom, Li and Kirubarajan, *Estimation
    with Applications to Tracking and Navigation*, sec. 6.2.2.
    """
    densities = {
        "acceleration_noise": acceleration_noise,
        "down_acceleration_noise": down_acceleration_noise,
        "position_walk": position_walk,
        "down_position_walk": down_position_walk,
        "baro_walk": baro_walk,
    }
    deviations = {
        "gps_position_sd": gps_position_sd,
        "gps_speed_sd": gps_speed_sd,
        "gps_down_sd": gps_down_sd,
        "gps_down_speed_sd": gps_down_speed_sd,
        "baro_sd": baro_sd,
    }
    correlations = {
        "gps_correlation": gps_correlation,
        "gps_down_correlation": gps_down_correlation,
    }
    _check(densities, deviations, correlations)
    p, v, bias = np.arange(3), np.arange(3, 6), 6
    rate = np.zeros((7, 7))
    rate[p, v] = 1.0
    walk = [position_walk, position_walk, down_position_walk]
    noise = [acceleration_noise, acceleration_noise, down_acceleration_noise]
    C = np.eye(7)
    C[6, 2] = -1.0
    sd_p = np.array([gps_position_sd, gps_position_sd, gps_down_sd])
    sd_v = np.array([gps_speed_sd, gps_speed_sd, gps_down_speed_sd])
    R = np.diag(np.concatenate([sd_p, sd_v, [baro_sd]]) ** 2)
    R[p, v] = R[v, p] = (
        np.array([gps_correlation, gps_correlation, gps_down_correlation]) * sd_p * sd_v
    )
    return linear_plant(
        time="continuous",
        noise="white",
        dt=dt,
        A=rate,
        C=C,
        H=np.eye(7)[:, :bias],
        Q=np.diag(np.concatenate([walk, noise, [baro_walk]]) ** 2),
        R=R,
        states=[*AXES, *(f"{axis}_speed" for axis in AXES), "baro_bias"],
        outputs=[*GPS, "baro"],
        attacks=[f"{name}_spoof" for name in GPS],
    )


def _check(
    densities: dict[str, float], deviations: dict[str, float], correlations: dict[str, float]
) -> None:
    for key, value in densities.items():
        if not (np.isfinite(value) and value >= 0):
            raise InvalidValue(key, value, "a noise density, 0 or more")
    for key, value in deviations.items():
        if not (np.isfinite(value) and value > 0):
            raise InvalidValue(key, value, "a standard deviation over 0")
    for key, value in correlations.items():
        if not abs(value) < 1:
            raise InvalidValue(key, value, "a correlation inside (-1, 1)")
