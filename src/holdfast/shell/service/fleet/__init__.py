"""Many plants of one model in one process: a batch for every message, keyed by plant."""
