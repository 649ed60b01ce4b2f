"""The tables of a study as one HTML page."""
