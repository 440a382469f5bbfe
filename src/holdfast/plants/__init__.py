"""Plants: linear (constant, per step or scheduled) and nonlinear."""
