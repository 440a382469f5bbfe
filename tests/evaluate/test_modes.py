"""Accuracy of the mode believed in, and how soon it was, on rows counted by hand."""

import numpy as np

from holdfast.evaluate.modes import accuracy, spells

TRUTH = np.array([0, 0, 0, 2, 2, -1, 2, 1, 1, 1])
BELIEVED = np.array([0, 1, 0, 0, 2, 2, 2, 0, 0, 0])


def test_accuracy_counts_the_rows_with_a_true_mode():
    found = accuracy(BELIEVED, TRUTH)
    assert (found.hits, found.of) == (4, 9)
    both = accuracy(np.stack([BELIEVED, TRUTH]), np.stack([TRUTH, TRUTH]))
    assert (both.hits, both.of) == (13, 18)
    assert np.isnan(accuracy([0, 0], [-1, -1]).value)


def test_spells_end_where_the_truth_changes():
    found = spells(BELIEVED, TRUTH)
    assert [(s.mode, s.first, s.last) for s in found] == [
        (0, 0, 2),
        (2, 3, 4),
        (2, 6, 6),
        (1, 7, 9),
    ]
    assert [s.delay for s in found] == [0, 1, 0, np.inf]
    assert [(s.right.hits, s.right.of) for s in found] == [(2, 3), (1, 2), (1, 1), (0, 3)]
    assert spells([], []) == []
