"""A virtual bus: what the DBC describes arrives, what cannot be read is counted."""

import asyncio
import contextlib

import can
import pytest

from holdfast.shell.errors import InputError
from holdfast.shell.service.can import CanSource

DBC = """VERSION ""

NS_ :

BS_:

BU_: ECU

BO_ 256 WheelSpeeds: 4 ECU
 SG_ front_left : 0|16@1+ (0.01,0) [0|655.35] "m/s" Vector__XXX
 SG_ front_right : 16|16@1- (0.01,-1) [-300|300] "m/s" Vector__XXX

BO_ 2566844672 Steering: 8 ECU
 SG_ which M : 0|8@1+ (1,0) [0|255] "" Vector__XXX
 SG_ angle m0 : 8|16@1- (0.1,0) [-3000|3000] "deg" Vector__XXX
 SG_ rate m1 : 8|16@1- (0.1,0) [-3000|3000] "deg/s" Vector__XXX
"""
SPEEDS, STEERING = 256, 2566844672 & 0x1FFFFFFF
SIGNALS = {
    "y:left": "WheelSpeeds.front_left",
    "y:right": "WheelSpeeds.front_right",
    "u:angle": "Steering.angle",
}


@pytest.fixture
def dbc(tmp_path):
    path = tmp_path / "car.dbc"
    path.write_text(DBC)
    return path


def source(dbc, channel="speeds", interface="virtual", signals=SIGNALS):
    return CanSource("can[1]", interface, channel, dbc, signals, "live.toml", "source[1]")


async def received(found, channel, messages):
    """What the source takes of these messages."""
    taken = []
    task = asyncio.create_task(found.run(taken.append))
    with can.Bus(channel, "virtual") as sender:
        probe = can.Message(arbitration_id=SPEEDS, data=bytes(4), is_extended_id=False)
        async with asyncio.timeout(3):
            while not taken:  # until it listens
                sender.send(probe)
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.05)
            before, start = len(taken), found.counters.messages
            for message in messages:
                sender.send(message)
            while found.counters.messages < start + len(messages):
                await asyncio.sleep(0.01)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    return taken[before:]


def test_signals_of_two_messages(dbc):
    messages = [
        can.Message(timestamp=5.0, arbitration_id=SPEEDS, is_extended_id=False,
                    data=(1234).to_bytes(2, "little") + (-50 & 0xFFFF).to_bytes(2, "little")),
        can.Message(arbitration_id=STEERING, data=b"\0" + (255).to_bytes(2, "little") + bytes(5)),
    ]  # fmt: skip
    found = source(dbc)
    speeds, steering = asyncio.run(received(found, "speeds", messages))
    assert speeds.values == pytest.approx({"y:left": 12.34, "y:right": -1.5})
    assert steering.values == pytest.approx({"u:angle": 25.5})
    assert steering.time > 0
    assert not speeds.whole
    assert not speeds.trusted
    assert found.counters.rejected == 0


def test_what_cannot_be_read_is_counted(dbc):
    messages = [
        can.Message(arbitration_id=SPEEDS, is_extended_id=False, data=b"\1"),
        can.Message(arbitration_id=SPEEDS, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=SPEEDS, is_extended_id=False, is_error_frame=True),
        # a multiplexer's value that nobody described, and one with nothing of ours
        can.Message(arbitration_id=STEERING, data=b"\7" + bytes(7)),
        can.Message(arbitration_id=STEERING, data=b"\1" + bytes(7)),
    ]
    found = source(dbc, "rubbish")
    assert asyncio.run(received(found, "rubbish", messages)) == []
    assert found.counters.rejected == 5


def test_a_bus_that_fails_is_opened_again(dbc, monkeypatch):
    found, opened = source(dbc, "failing"), []

    class Failing:
        def recv(self, timeout):
            raise can.CanOperationError("the cable is out")

        def shutdown(self):
            opened.append("closed")

    true = found._open

    def open_():
        opened.append("opened")
        return Failing() if len(opened) == 1 else true()

    monkeypatch.setattr(found, "_open", open_)
    assert asyncio.run(received(found, "failing", [])) == []
    assert found.counters.disconnects == 1
    assert sorted(opened) == ["closed", "opened", "opened"]


@pytest.mark.parametrize(
    ("change", "key", "expected"),
    [
        ({"signals": {"y:left": "WheelSpeed.front_left"}}, "source[1].signals.WheelSpeed.front_",
         "did you mean 'WheelSpeeds'?"),
        ({"signals": {"y:left": "WheelSpeeds.front_lefd"}}, "source[1].signals.WheelSpeeds.front_",
         "did you mean 'front_left'?"),
        ({"signals": {"y:left": "WheelSpeeds"}}, "source[1].signals.WheelSpeeds", "'front_left'"),
        ({"interface": "socketkan"}, "source[1].interface", "did you mean 'socketcan'?"),
    ],
)  # fmt: skip
def test_what_there_is_not(dbc, change, key, expected):
    with pytest.raises(InputError) as caught:
        source(dbc, **change)
    assert str(caught.value).startswith(f"live.toml: {key}")
    assert expected in str(caught.value)


OVERLAPPING = b"""BO_ 256 Two: 1 ECU
 SG_ a : 0|8@1+ (1,0) [0|255] "" ECU
 SG_ b : 4|4@1+ (1,0) [0|15] "" ECU
"""


@pytest.mark.parametrize("content", [b"rubbish\xff", OVERLAPPING])
def test_a_file_that_is_none(tmp_path, content):
    path = tmp_path / "car.dbc"
    path.write_bytes(content)
    with pytest.raises(InputError, match="a DBC file"):
        source(path)
    with pytest.raises(InputError, match="no such file"):
        source(tmp_path / "none.dbc")
