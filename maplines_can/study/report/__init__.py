"""The HTML report on the tables of a sweep."""
