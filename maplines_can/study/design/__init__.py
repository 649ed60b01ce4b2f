"""A wire to order: widths, factors and the order of rows that meet a target."""
