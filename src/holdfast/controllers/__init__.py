"""Controllers: the input to apply next, from an estimate."""
