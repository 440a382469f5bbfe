"""What can be said of a plant before any data."""
