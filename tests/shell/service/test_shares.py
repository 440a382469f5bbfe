"""Processes that share a fleet: whoever comes, goes or dies, each shard ends with one owner."""

import random
from collections import deque

import pytest

from holdfast.shell.service.fleet.shares import AGAIN, Shares

SHARDS = 7


class Broker:
    """Retained words, shared offers, and for each process the same words in the same order."""

    def __init__(self, rng):
        self.rng, self.members, self.words = rng, {}, {}
        self.presence, self.owners = {}, {}
        self.now = 0.0

    def join(self, name):
        """A process connects, says that it is there, and hears what is retained."""
        self.members[name], self.words[name] = Shares(name, SHARDS), deque()
        self.say("presence", name, True)
        self.words[name].extend(("presence", who, True) for who in self.presence)
        self.words[name].extend(("owner", *pair) for pair in self.owners.items())

    def die(self, name):
        """Nothing more is heard of it: its last will goes out."""
        del self.members[name], self.words[name]
        self.presence.pop(name, None)
        self.say("presence", name, False)

    def say(self, kind, *what):
        """To everybody."""
        if kind == "presence" and what[1]:
            self.presence[what[0]] = True
        if kind == "owner":
            self.owners[what[0]] = what[1]
        for words in self.words.values():
            words.append((kind, *what))

    def do(self, name, actions):
        """What a process does about its actions."""
        me = self.members[name]
        for kind, shard in actions:
            if kind == "offer":
                to = self.rng.choice(sorted(self.members))
                self.words[to].append(("offer", shard))
            elif kind == "claim":
                self.say("owner", shard, name)
            elif kind == "drop":
                me.dropped(shard)
                if me.owns(shard):
                    self.say("owner", shard, "")

    def step(self, name):
        """One word for one process."""
        if self.words[name]:
            kind, *what = self.words[name].popleft()
            self.do(name, getattr(self.members[name], f"hear_{kind}")(*what))

    def leave(self, name):
        """A process stops in order: it hears on until its own words have come back."""
        me = self.members[name]
        self.do(name, me.leave())
        while me.waiting:
            self.step(self.rng.choice([who for who, words in self.words.items() if words]))
        assert name not in self.owners.values()
        self.die(name)

    def settle(self):
        """Until nothing is said any more, and some ticks beyond."""
        for _ in range(60):
            self.now += AGAIN
            for name in list(self.members):
                self.do(name, self.members[name].tick(self.now))
            for _ in range(10_000):
                busy = [name for name, words in self.words.items() if words]
                if not busy:
                    break
                self.step(self.rng.choice(busy))


@pytest.mark.parametrize("first", range(0, 400, 100))
def test_every_shard_ends_with_one_owner_that_lives(first):
    for seed in range(first, first + 100):
        rng = random.Random(seed)
        lived(rng, rng.choices("jjdls", k=rng.randrange(41)))


def lived(rng, deeds):
    """Processes join, die and speak in any order, then all is said."""
    broker, born = Broker(rng), 0
    for deed in ["j", *deeds]:
        if deed == "j":
            born += 1
            broker.join(f"{rng.random():.6f}-{born}")
        elif deed in "dl" and len(broker.members) > 1:
            (broker.die if deed == "d" else broker.leave)(rng.choice(sorted(broker.members)))
        else:
            for _ in range(rng.randrange(20)):
                broker.step(rng.choice(sorted(broker.members)))
            broker.now += rng.random()
            some = rng.choice(sorted(broker.members))
            broker.do(some, broker.members[some].tick(broker.now))
    broker.settle()
    owned = sorted(shard for member in broker.members.values() for shard in member.ours)
    assert owned == list(range(SHARDS))
    for name, member in broker.members.items():
        assert len(member.ours) <= member.fair
        assert all(broker.owners[shard] == name for shard in member.ours)
    # and nobody says anything any more
    assert all(not member.tick(broker.now + 10 * AGAIN) for member in broker.members.values())
