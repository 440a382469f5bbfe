"""MAVLink over UDP: fields arrive, signatures count, and no bytes do harm."""

import asyncio
import contextlib
import json
import math
import socket
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from holdfast.shell.errors import InputError
from holdfast.shell.service.mavlink import DATAGRAM, EPOCH, MavlinkSource

KEY = bytes(range(32))
SIGNALS = {
    "y:north": "LOCAL_POSITION_NED.x",
    "y:east": "LOCAL_POSITION_NED.y",
    "u:throttle": "VFR_HUD.throttle",
    "y:pressure": "SCALED_PRESSURE.press_abs",
    "y:gyro": "HIGHRES_IMU.xgyro",
}


def source(key_bytes=None, signals=SIGNALS, port=14550):
    return MavlinkSource(
        "mavlink[1]", "127.0.0.1", port, signals, "live.toml", "source[1]", key_bytes
    )


def vehicle(key=None, age=0.0):
    """A sender; ``age``: by how many seconds its signatures are behind."""
    found = common.MAVLink(None, srcSystem=1, srcComponent=1)
    if key is not None:
        found.signing.secret_key, found.signing.sign_outgoing = key, True
        found.signing.timestamp = int((time.time() - EPOCH - age) * 1e5)
    return found


def position(x, y=2.5, at=1500):
    return common.MAVLink_local_position_ned_message(at, x, y, 0.0, 0.0, 0.0, 0.0)


def taken_of(found, *datagrams):
    """What the source takes of these datagrams."""
    taken = []
    for data in datagrams:
        found._datagram(bytes(data), taken.append)
    return taken


def test_fields_and_times():
    sender, found = vehicle(), source()
    imu = common.MAVLink_highres_imu_message(
        2_500_000, 0.0, 0.0, 0.0, 0.5, *[0.0] * 9, fields_updated=0
    )
    hud = common.MAVLink_vfr_hud_message(0.0, 0.0, 0, 55, 0.0, 0.0)
    heartbeat = common.MAVLink_heartbeat_message(0, 0, 0, 0, 0, 3)
    packed = [one.pack(sender) for one in (position(1.5), imu, heartbeat, hud)]
    # several frames in one datagram, and one in one
    place, gyro, throttle = taken_of(found, b"".join(packed[:3]), packed[3])
    assert place == (1.5, {"y:north": 1.5, "y:east": 2.5}, frozenset(), {}, False)
    assert gyro.time == 2.5
    assert gyro.values == {"y:gyro": 0.5}
    assert math.isnan(throttle.time)
    assert throttle.values == {"u:throttle": 55.0}
    assert (found.counters.messages, found.counters.rejected) == (4, 0)


def test_signed_is_trusted_and_the_rest_is_not():
    sender, found = vehicle(KEY), source(KEY)
    signed = position(1.0).pack(sender)
    plain = position(2.0).pack(vehicle())
    (first,) = taken_of(found, signed)
    assert first.trusted == {"north", "east"}
    (second,) = taken_of(found, plain)
    assert second.values["y:north"] == 2.0
    assert second.trusted == frozenset()
    forged = bytes(signed[:-1]) + bytes((signed[-1] ^ 1,))
    other = position(3.0).pack(vehicle(KEY[::-1]))
    old = position(4.0).pack(vehicle(KEY, age=120.0))
    assert taken_of(found, signed, forged, other, old) == []
    assert found.counters.rejected == 4
    (last,) = taken_of(found, position(5.0).pack(sender))
    assert last.trusted == {"north", "east"}


def test_inputs_are_never_trusted():
    hud = common.MAVLink_vfr_hud_message(0.0, 0.0, 0, 55, 0.0, 0.0)
    (found,) = taken_of(source(KEY), hud.pack(vehicle(KEY)))
    assert found.values == {"u:throttle": 55.0}
    assert found.trusted == frozenset()


def test_damage_is_counted():
    found, frame = source(), bytes(position(1.0).pack(vehicle()))
    flipped = frame[:12] + bytes((frame[12] ^ 4,)) + frame[13:]
    unknown_flag = frame[:2] + b"\2" + frame[3:]
    version_1 = bytes(position(1.0).pack(vehicle(), force_mavlink1=True))
    bad = [flipped, unknown_flag, version_1, frame[:-1], b"\xfd", b"text", bytes(DATAGRAM + 1)]
    assert taken_of(found, *bad) == []
    assert found.counters.rejected == len(bad)
    # what follows rubbish is not looked for; what goes before it is taken
    assert len(taken_of(found, frame + b"??" + frame)) == 1


def test_values_that_are_not_finite_are_faults():
    (found,) = taken_of(source(), position(math.nan).pack(vehicle()))
    assert math.isnan(found.values["y:north"])


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300), st.booleans(), st.integers(0, 60), st.integers(0, 255))
def test_no_bytes_do_harm(noise, signed, at, byte):
    found = source(KEY)
    frame = bytes(position(1.0).pack(vehicle(KEY if signed else None)))
    at %= len(frame)
    changed = frame[:at] + bytes((byte,)) + frame[at + 1 :]
    taken = taken_of(found, noise, b"\xfd" + noise, changed, noise + frame, frame)
    # a frame that has been changed is taken only if the change is none
    assert all(one.values == {"y:north": 1.0, "y:east": 2.5} for one in taken)
    # an empty datagram holds no message
    assert found.counters.messages >= 4
    assert taken


def test_over_a_socket_and_with_one_that_is_taken_first():
    async def play():
        taken = []
        with socket.socket(type=socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", 0))
            port = other.getsockname()[1]
            found = source(port=port)
            task = asyncio.create_task(found.run(taken.append))
            async with asyncio.timeout(3):
                while not found.counters.disconnects:
                    await asyncio.sleep(0.005)
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            async with asyncio.timeout(3):
                while not taken:
                    sender.sendto(position(7.0).pack(vehicle()), ("127.0.0.1", port))
                    await asyncio.sleep(0.01)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        return taken[0]

    assert asyncio.run(play()).values["y:north"] == 7.0


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        ("LOCAL_POSITION_NDE.x", "did you mean 'LOCAL_POSITION_NED'?"),
        ("VFR_HUD.throtle", "did you mean 'throttle'?"),
        ("VFR_HUD", "'airspeed'"),
        ("ATTITUDE_TARGET.q", "'body_roll_rate'"),
        ("STATUSTEXT.text", "'severity'"),
    ],
)
def test_what_there_is_not(signal, expected):
    with pytest.raises(InputError) as caught:
        source(signals={"y:north": signal})
    assert str(caught.value).startswith(f"live.toml: source[1].signals.{signal}: found ")
    assert expected in str(caught.value)


def test_after_a_restart_nothing_is_accepted_twice():
    """What was sent in the last minute is not too old: the checkpoint has to know of it."""
    sender, found = vehicle(KEY), source(KEY)
    frames = [position(float(k)).pack(sender) for k in range(3)]
    assert len(taken_of(found, *frames)) == 3
    again = source(KEY)
    again.restore(json.loads(json.dumps(found.held())))
    assert taken_of(again, *frames) == []
    assert again.counters.rejected == 3
    assert len(taken_of(again, position(4.0).pack(sender))) == 1
    assert len(taken_of(source(KEY), *frames)) == 3  # as it is without
    assert source().held() is None
