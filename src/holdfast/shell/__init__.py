"""The thin shell: reads, serves and writes; no mathematics."""
