"""Scores: pure functions of arrays, each with its uncertainty where it has one."""
