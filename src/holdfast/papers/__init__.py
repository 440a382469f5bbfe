"""The papers' examples and claims, run again and judged."""
