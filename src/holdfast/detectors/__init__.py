"""Detectors: a verdict from the record of every step."""
