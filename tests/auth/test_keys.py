import pytest

from holdfast.auth import Key, KeyRing

ONE, TWO, THREE = (Key(i, bytes(16), first) for i, first in ((1, 0), (2, 10), (3, 20)))


def test_exactly_one_key_is_active():
    ring = KeyRing((TWO, THREE))
    found = [ring.at(value) for value in (0, 9, 10, 19, 20, 10**9)]
    assert found == [None, None, TWO, TWO, THREE, THREE]


def test_rings_grow_at_the_new_end_and_shrink_at_the_old():
    ring = KeyRing((ONE,)).rotated(TWO).rotated(THREE)
    assert ring.keys == (ONE, TWO, THREE)
    assert ring.without([1]) == KeyRing((TWO, THREE))
    assert ring.without([]) == ring
    with pytest.raises(ValueError, match="expected the oldest"):
        ring.without([2])
    with pytest.raises(ValueError, match="rising"):
        ring.without([1, 2, 3])
    with pytest.raises(ValueError, match="rising"):
        KeyRing((TWO,)).rotated(Key(7, bytes(16), 10))
    with pytest.raises(ValueError, match="each once"):
        KeyRing((ONE,)).rotated(Key(1, bytes(16), 10))
    with pytest.raises(ValueError, match="first: found -1"):
        Key(1, bytes(16), -1)


def test_secrets_stay_out_of_sight():
    assert "secret" not in repr(KeyRing.of(b"secret bytes 123"))


def test_the_length_of_a_secret_is_checked():
    with pytest.raises(ValueError, match="key 1: found 16 bytes, expected 32"):
        KeyRing((ONE,)).sized(32)
