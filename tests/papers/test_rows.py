"""How a verdict follows from numbers."""

import json

import numpy as np
import pytest

from holdfast.papers import rows


def test_a_number_within_three_deviations_of_a_run_is_reproduced():
    seeds = np.array([9.0, 10.0, 11.0])  # mean 10, standard deviation 1
    assert rows.number("t", "w", 12.9, seeds).verdict == "reproduced"
    assert rows.number("t", "w", 13.1, seeds).verdict == "not reproduced"
    row = rows.number("t", "w", 12.9, seeds)
    assert (row.ours, row.spread) == (10.0, 1.0)


def test_one_wrong_number_in_a_list_is_enough():
    seeds = np.array([[9.0, 100.0], [10.0, 101.0], [11.0, 102.0]])
    assert rows.number("t", "w", [10.5, 101.5], seeds).verdict == "reproduced"
    assert rows.number("t", "w", [10.5, 110.0], seeds).verdict == "not reproduced"


def test_without_a_spread_half_a_per_cent_is_allowed():
    seeds = np.full(3, 1000.0)
    assert rows.number("t", "w", 1004.0, seeds).verdict == "reproduced"
    assert rows.number("t", "w", 1006.0, seeds).verdict == "not reproduced"


def test_a_spread_needs_two_seeds():
    with pytest.raises(ValueError, match="two seeds"):
        rows.number("t", "w", 1.0, np.array([1.0]))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"verdict": "true"}, "none of"),
        ({"what": "w" * 150}, "150 characters"),
        ({"verdict": "proof read only", "note": ""}, "without a reason"),
        ({"verdict": "unstated", "note": ""}, "without a reason"),
    ],
)
def test_rows_that_say_too_little_or_too_much_are_refused(change, said):
    sound = {
        "id": "t", "what": "w", "paper": 1.0, "ours": 1.0, "spread": None, "verdict": "holds",
    }  # fmt: skip
    rows.Row(**sound)
    with pytest.raises(ValueError, match=said):
        rows.Row(**(sound | change))


def test_a_row_is_plain_json():
    row = rows.claim("t", "w", None, [np.float64(1.5), np.int64(2), np.bool_(True)], True)
    assert json.loads(json.dumps(row.as_dict()))["ours"] == [1.5, 2, True]
    assert list(row.as_dict()) == ["id", "what", "paper", "ours", "spread", "verdict", "note"]
