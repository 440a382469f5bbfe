"""How large must a lie of the GPS be to be seen, and what does it do to three estimators?

Run: python examples/80_campaign.py
"""

import tempfile
from pathlib import Path

import holdfast

STUDY = Path(__file__).parent / "scenarios" / "gps_study.toml"


def main():
    # a folder makes it resumable: the second call finds every block and computes none
    with tempfile.TemporaryDirectory() as folder:
        found = holdfast.run_study(STUDY, folder)
        again = holdfast.run_study(STUDY, folder)
    assert found.summary.equals(again.summary)
    for score in ("state_rmse:place", "detected_share", "missed_share"):
        print(f"\n{score}, mean of {found.attrs['runs']} runs and its 95 % interval")
        for name in found["estimator"].values:
            cells = []
            for size in found["attack[1].value"].values:
                one = found.summary.sel(
                    {"attack[1].value": size, "estimator": name, "score": score}
                )
                mean, low, high = (float(one.sel(statistic=s)) for s in ("mean", "low", "high"))
                cells.append(f"{size:g} m: {mean:.3f} [{low:.3f}, {high:.3f}]")
            print(f"  {name:14}", "   ".join(cells))
    place = found.summary.sel({"score": "state_rmse:place", "statistic": "mean"})
    small, large = (place.sel({"attack[1].value": v}) for v in (0.5, 4.0))
    # a filter that believes its GPS is led away in proportion; one that leaves the attack free is
    # not, and the bank takes the better of the two, except where a lie is too small to be seen
    assert large.sel(estimator="Kalman") > 5 * small.sel(estimator="Kalman")
    assert (
        abs(large.sel(estimator="unknown input") / small.sel(estimator="unknown input") - 1) < 0.1
    )
    assert large.sel(estimator="bank") < 1.05 * large.sel(estimator="unknown input")


if __name__ == "__main__":
    main()
