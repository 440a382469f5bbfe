"""Many runs: calibration of thresholds, and what a detector cannot see."""
