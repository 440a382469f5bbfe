"""Plain-array mathematics. Nothing here knows a plant, an estimator or a record."""
