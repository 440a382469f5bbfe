"""The live service: sources -> frames -> `Live` -> sinks, with clocks, gaps, health and a page."""
