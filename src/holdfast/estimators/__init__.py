"""Estimators: state and attack from observations."""
