"""Which plants there are: each has a place in the arrays, found by its id."""

import numpy as np


class Members:
    """Up to ``most`` plants by their ids; what does not fit is turned away."""

    def __init__(self, most: int):
        self.most = most
        self._places: dict[int, int] = {}
        self._free = list(range(most - 1, -1, -1))
        self.ids = np.zeros(most, np.uint64)
        """The plant at each place; only of those that are taken."""
        self.taken = np.zeros(0, int)
        """The places that are taken, in order."""

    def __len__(self) -> int:
        return len(self._places)

    def places(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The place of each plant, -1 where there is none left, and which are new."""
        get = self._places.get
        found = np.array([get(i, -1) for i in ids.tolist()], int)
        new = np.zeros(len(found), bool)
        for at in np.flatnonzero(found < 0):
            if self._free:
                found[at] = self._admit(int(ids[at]))
                new[at] = True
        if new.any():
            self._note_taken()
        return found, new

    def leave(self, places: np.ndarray) -> None:
        """Give up the plants at these places."""
        for place in places.tolist():
            del self._places[int(self.ids[place])]
            self._free.append(place)
        self._note_taken()

    def _note_taken(self) -> None:
        self.taken = np.sort(np.fromiter(self._places.values(), int, len(self._places)))

    def _admit(self, identity: int) -> int:
        place = self._free.pop()
        self._places[identity] = place
        self.ids[place] = identity
        return place

    def restore(self, ids: np.ndarray, places: np.ndarray) -> None:
        """These plants at these places, and no others."""
        pairs = zip(ids.tolist(), places.tolist(), strict=True)
        self._places = {int(identity): int(place) for identity, place in pairs}
        self.ids[places] = ids
        held = set(self._places.values())
        self._free = [place for place in range(self.most - 1, -1, -1) if place not in held]
        self._note_taken()
