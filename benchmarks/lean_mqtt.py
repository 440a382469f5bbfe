"""As much of MQTT 5 as a benchmark needs, so that the client costs little of what is measured."""

import socket
import struct


def _varint(value):
    found = bytearray()
    while True:
        value, low = divmod(value, 128)
        found.append(low | (128 if value else 0))
        if not value:
            return bytes(found)


def _text(value):
    data = value.encode()
    return struct.pack(">H", len(data)) + data


def _packet(kind, body):
    return bytes([kind]) + _varint(len(body)) + body


class Client:
    """A connection to a broker on the loopback; qos 0 only."""

    def __init__(self, port):
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._held = bytearray()
        clean, keepalive = 2, 0
        head = _text("MQTT") + bytes([5, clean]) + struct.pack(">H", keepalive) + b"\0"
        self._socket.sendall(_packet(0x10, head + _text("")))
        self._expect(0x20)

    def subscribe(self, topic):
        """Receive what is published there from now on."""
        self._socket.sendall(_packet(0x82, b"\0\1\0" + _text(topic) + b"\0"))
        self._expect(0x90)

    def publish(self, topic, payload):
        """Send one message."""
        self._socket.sendall(_packet(0x30, _text(topic) + b"\0" + payload))

    def messages(self, go_on):
        """Payloads as they come, as long as ``go_on()``."""
        self._socket.settimeout(2.0)
        try:
            while go_on():
                kind, body = self._read()
                if kind & 0xF0 == 0x30:
                    length = struct.unpack_from(">H", body)[0]
                    yield body[length + 3 :]  # no properties: their length is one byte
        except TimeoutError:
            return

    def close(self):
        """Hang up."""
        self._socket.close()

    def _expect(self, kind):
        found, body = self._read()
        if found != kind or body[1 if kind == 0x20 else -1] >= 128:
            raise RuntimeError(f"the broker refused: {found:#x} {body.hex()}")

    def _read(self):
        while True:
            found = self._parsed()
            if found is not None:
                return found
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionError("the broker has hung up")
            self._held += data

    def _parsed(self):
        length, shift = 0, 0
        for at in range(1, min(len(self._held), 5)):
            length |= (self._held[at] & 127) << shift
            shift += 7
            if self._held[at] < 128:
                end = at + 1 + length
                if len(self._held) < end:
                    return None
                kind, body = self._held[0], bytes(self._held[at + 1 : end])
                del self._held[:end]
                return kind, body
        return None
