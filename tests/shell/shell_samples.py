"""A scenario and a log, both sound, for tests to spoil."""

SCENARIO = """\
[plant]
kind = "linear"
dt = 0.1
A = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.005], [0.1]]
C = [[1.0, 0.0], [0.0, 1.0]]
G = [[0.005], [0.1]]
Q = [[1e-6, 0.0], [0.0, 1e-4]]
R = [[0.25, 0.0], [0.0, 0.0025]]
states = ["position", "speed"]
inputs = ["accel"]
outputs = ["gps", "wheel"]
attacks = ["accel_attack"]

[estimator]
kind = "kalman"
x0 = [0.0, 0.0]
P0 = [[1.0, 0.0], [0.0, 1.0]]

[detector]
kind = "chi_square"
level = 0.01

[[attack]]
kind = "bias"
channel = "sensor:gps"
start = 1.0
stop = 2.0
value = 5.0

[run]
steps = 30
"""

LOG = "time,u:accel,y:gps,y:wheel\n" + "".join(
    f"{k / 10:.1f},{0.1 * k},{0.5 * k % 0.7},{0.01 * k}\n" for k in range(1, 13)
)
