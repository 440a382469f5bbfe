"""Attacks: what is added to sensors, actuators and attack channels, sample by sample."""
