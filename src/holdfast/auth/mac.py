"""AES-CMAC, from the library `cryptography`."""

from collections.abc import Callable
from hmac import compare_digest

from holdfast.auth.keys import KeyRing

try:
    from cryptography.hazmat.primitives.ciphers.algorithms import AES
    from cryptography.hazmat.primitives.cmac import CMAC
except ImportError as missing:
    raise ImportError(
        'holdfast.auth needs the package cryptography: pip install "holdfast[auth]"'
    ) from missing

KEY_BYTES = 16
MAC_BYTES = 16

Mac = Callable[[bytes], bytes]
"""From a message to its 16-byte code under one key."""

same = compare_digest
"""Equality of two byte strings, in a time that does not tell where they differ."""


def cmac(secret: bytes) -> Mac:
    """AES-128-CMAC under ``secret``. Raises `ValueError` unless it has 16 bytes.

    Source: RFC 4493, Section 2.4; NIST SP 800-38B.
    """
    if len(secret) != KEY_BYTES:
        raise ValueError(f"secret: found {len(secret)} bytes, expected {KEY_BYTES}")
    keyed = CMAC(AES(secret))  # a copy costs a third of the key schedule

    def mac(message: bytes) -> bytes:
        context = keyed.copy()
        context.update(message)
        return context.finalize()

    return mac


def by_value(ring: KeyRing) -> tuple[tuple[int, int, Mac], ...]:
    """For each key its first freshness value, id and code, newest first: what a search wants."""
    return tuple((key.first, key.id, cmac(key.secret)) for key in reversed(ring.keys))
